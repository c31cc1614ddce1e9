"""dask.distributed, imported when needed and quiet; and workers on this machine, each with a device of its own."""

import importlib.util
import logging
import warnings
from types import ModuleType
from typing import Any

from phyradgs_cl import checks
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


def has_dask() -> bool:
    """Whether dask.distributed is installed."""
    return importlib.util.find_spec("distributed") is not None


def distributed() -> ModuleType:
    """The package, or an InputError that says how to install it."""
    use = "the package that --scheduler and --workers need"
    package = checks.package("distributed", use, "phyradgs-cl[cluster]")
    for name in list(logging.root.manager.loggerDict):
        if name == "distributed" or name.startswith("distributed."):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    return package
