"""A scheduler and workers on this machine, one process per worker, each with a device of its own."""

import logging
import warnings
from typing import Any

from phyradgs_cl.cluster.library import distributed
from phyradgs_cl.cluster.workers import Workers
from phyradgs_cl.runtime import DEVICE_VARIABLE

RESOURCE = "device"
_HOST = "127.0.0.1"  # nobody else is to send work to this machine
_DASHBOARD = f"{_HOST}:8787"


def local_cluster(workers: Workers) -> Any:
    """Starts them; what is returned closes them. A worker that dies is replaced by its nanny. No limit of memory per
    worker: Dask would kill a run that is larger than its share, again and again."""
    package = distributed()
    spec = {number: _worker(package, device) for number, device in enumerate(workers.devices())}
    scheduler = {
        "cls": package.Scheduler,
        "options": {"host": _HOST, "port": 0, "dashboard": True, "dashboard_address": _DASHBOARD},
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a dashboard's port that is taken: another is found, and said
        return package.SpecCluster(workers=spec, scheduler=scheduler, silence_logs=logging.CRITICAL)


def _worker(package: Any, device: str) -> dict[str, Any]:
    options = {
        "host": _HOST,
        "nthreads": 1,
        "resources": {RESOURCE: 1},
        "env": {DEVICE_VARIABLE: device},
        "memory_limit": None,
        "preload": ["phyradgs_cl.cluster.preload"],
        "dashboard": False,
        "silence_logs": logging.CRITICAL,
    }
    return {"cls": package.Nanny, "options": options}
