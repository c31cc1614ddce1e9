"""Runs on many devices: workers of dask.distributed with one device each, on this machine or of a running scheduler."""

import asyncio
import functools
import importlib.util
import logging
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from phyradgs_cl import checks
from phyradgs_cl.errors import DeviceError, InputError
from phyradgs_cl.runtime import DEVICE_VARIABLE, Runtime, choose_device, list_devices

LOCAL = "local"
RESOURCE = "device"
_MOST_WORKERS, _MOST_RESTARTS = 1024, 3
_HOST = "127.0.0.1"  # other machines must not send work to this one
_CONNECT_S, _WAIT_S, _WITHOUT_WORKERS_S = 10.0, 0.2, 20.0
# up to Python 3.10 asyncio.TimeoutError is a different class
_NO_ANSWER = (TimeoutError, asyncio.TimeoutError, CancelledError, OSError)
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Workers:
    """The workers that make the runs.

    scheduler: ``local``, the address of a Dask scheduler (``tcp://host:8786``) or the JSON file that ``dask scheduler
    --scheduler-file`` has written. count: number of local workers; None is one per device. device: the devices of local
    workers, with commas; None is PHYRADGS_DEVICE's. Raises InputError for options that exclude each other."""

    scheduler: str = LOCAL
    count: int | None = None
    device: str | None = None

    def __post_init__(self) -> None:
        if not self.scheduler.strip():
            raise InputError("--scheduler", repr(self.scheduler), "local, an address or a scheduler file")
        if self.count is not None:
            checks.within("--workers", self.count, 1, _MOST_WORKERS)
        for option, value, expected in (
            ("--workers", self.count, "a number of local workers"),
            ("--device", self.device, f"{DEVICE_VARIABLE} in the environment of each worker"),
        ):
            if value is not None and not self.is_local:
                found = f"{value!r} together with --scheduler {self.scheduler}"
                raise InputError(option, found, expected, "leave it out: that scheduler has its own workers")

    @property
    def is_local(self) -> bool:
        return self.scheduler == LOCAL

    def devices(self) -> list[str]:
        """Returns the device of each local worker, as ``choose_device`` takes it; DeviceError for a missing one."""
        devices = _devices_of(self.device or os.environ.get(DEVICE_VARIABLE))
        count = len(devices) if self.count is None else self.count
        return [devices[worker % len(devices)] for worker in range(count)]


def _devices_of(option: str | None) -> list[str]:
    """Splits a list with commas; ``gpu``, or no option on a machine with GPUs, is all of them."""
    if option is None or option.lower() == "gpu":
        best, _ = choose_device(option)
        if best.kind != "gpu":
            return [str(best.index)]
        return [str(d.index) for d in list_devices() if d.kind == "gpu" and d.by_default]
    devices = [part.strip() for part in option.split(",")]
    for device in devices:
        if not device:
            raise InputError("--device", repr(option), "devices with commas between them")
        choose_device(device)
    return devices


@dataclass(frozen=True)
class Lost:
    """The result of a run whose workers died, as often as ``distributed.scheduler.allowed-failures`` permits."""

    reason: str


class Pool:
    """A connection to workers, used as a context. On leaving it, local workers end and others stay. Raises InputError where
    no scheduler answers, or where dask.distributed is missing; DeviceError where local workers do not start."""

    def __init__(self, workers: Workers) -> None:
        self.workers = workers
        self._cluster: Any = None
        self._client: Any = None
        self._restarts = 0

    def __enter__(self) -> "Pool":
        dask = distributed()
        try:
            if self.workers.is_local:
                self._cluster = _local_cluster(dask, self.workers.devices())
            self._client = dask.Client(**self._address(), timeout=_CONNECT_S, set_as_default=False)
        except (RuntimeError, ValueError, *_NO_ANSWER) as error:  # ValueError: no address, or no JSON
            self._close()
            found = f"no answer ({str(error) or type(error).__name__})"
            if self.workers.is_local:
                raise DeviceError(self._subject, found, "running processes", "try fewer --workers") from error
            expected = "the address or the scheduler file of a running Dask scheduler"
            raise InputError(self._subject, found, expected, "start one with 'dask scheduler'") from error
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    @property
    def dashboard(self) -> str:
        """The address of Dask's page about the workers; empty where there is none."""
        return str(self._client.dashboard_link or "")

    def results(
        self, function: Callable[[Any], Any], arguments: Mapping[str, Any],
        report: Callable[[int, int], None] = lambda running, devices: None,
    ) -> Iterator[tuple[str, Any]]:
        """Yields (name, ``function(argument)`` or Lost) of every argument, in the order in which they finish. No more runs
        are submitted than the workers have devices: Dask also counts a worker's death against the runs that wait there.
        ``report`` gets the numbers of running runs and of devices, several times a second. Raises the first exception of
        ``function``, which ends the other runs, and InputError when the scheduler ends."""
        waiting, running = deque(arguments), dict[Any, str]()
        seen_s = time.monotonic()
        try:
            while waiting or running:
                devices = self._count_devices()
                if devices:
                    seen_s = time.monotonic()
                elif time.monotonic() - seen_s > _WITHOUT_WORKERS_S:
                    self._await_workers()
                    if self.workers.is_local:  # with a new scheduler, which knows none of these runs
                        waiting.extendleft(running.values())
                        running.clear()
                    seen_s = time.monotonic()
                while waiting and len(running) < devices:
                    name = waiting.popleft()
                    key = f"{name}-{time.time_ns():x}"  # unique: the scheduler must not return an earlier result
                    how = {"key": key, "resources": {RESOURCE: 1}, "pure": False}
                    running[self._client.submit(function, arguments[name], **how)] = name
                report(len(running), devices)
                for future in self._wait(running):
                    yield running.pop(future), self._result(future)
        finally:
            if self._client.status == "running":
                self._client.cancel(list(running))

    def _wait(self, running: Mapping[Any, str]) -> set[Any]:
        """Returns the futures that have finished, after at most ``_WAIT_S``."""
        if not running:
            time.sleep(_WAIT_S)
            return set()
        with self._needing_the_scheduler(), self._client.as_current():
            try:
                return set(distributed().wait(list(running), timeout=_WAIT_S, return_when="FIRST_COMPLETED").done)
            except (TimeoutError, asyncio.TimeoutError):
                return set()

    def _result(self, future: Any) -> Any:
        with self._needing_the_scheduler():
            if future.status != "error":
                return future.result(timeout=_CONNECT_S)
            error = future.exception(timeout=_CONNECT_S)
        if isinstance(error, distributed().KilledWorker):
            return Lost(f"{error.allowed_failures + 1} workers died at it")
        if isinstance(error, ImportError):
            expected, remedy = "the phyradgs-cl of this process", "install the same version there"
            raise InputError("a worker", str(error), expected, remedy) from error
        raise error

    def _count_devices(self) -> int:
        with self._needing_the_scheduler():
            workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
            if self._client.status != "running":
                raise OSError("no connection")
        return sum(int(worker.get("resources", {}).get(RESOURCE, 0)) for worker in workers)

    @contextmanager
    def _needing_the_scheduler(self) -> Iterator[None]:
        try:
            yield
        except _NO_ANSWER as error:
            expected, remedy = "a running scheduler", "start it, and repeat the command to continue"
            raise InputError(self._subject, "gone", expected, remedy) from error

    def _address(self) -> dict[str, Any]:
        """Returns the arguments of ``distributed.Client`` that say where the scheduler is."""
        scheduler = self.workers.scheduler
        if self._cluster is not None:
            return {"address": self._cluster}
        if not scheduler.endswith(".json"):
            return {"address": scheduler}
        if not Path(scheduler).is_file():  # Dask would wait for the file
            raise FileNotFoundError("no such file")
        return {"scheduler_file": scheduler}

    def _await_workers(self) -> None:
        """Starts local workers again: Dask gives up a worker that dies while it starts. Warns of others that are missing."""
        if not self.workers.is_local:
            start = f"dask worker {self.workers.scheduler} --nthreads 1 --resources {RESOURCE}=1"
            log.warning("no worker with the resource %s: waiting for one ('%s')", RESOURCE, start)
            return
        self._restarts += 1
        if self._restarts > _MOST_RESTARTS:
            raise DeviceError(self._subject, "no process left", "running processes", "try fewer --workers")
        log.warning("no local worker is left: starting them again")
        self._close()
        self.__enter__()

    @property
    def _subject(self) -> str:
        return "local workers" if self.workers.is_local else f"--scheduler {self.workers.scheduler}"

    def _close(self) -> None:
        for part in (self._client, self._cluster):
            if part is not None:
                part.close(timeout=_CONNECT_S)


def _local_cluster(dask: ModuleType, devices: list[str]) -> Any:
    """Starts a worker per device on this machine. Dask replaces a worker that dies. The workers have no limit of memory:
    Dask would kill a run that needs more than its share, again and again."""
    return dask.LocalCluster(
        n_workers=len(devices), threads_per_worker=1, host=_HOST, dashboard_address=":0", memory_limit=None,
        resources={RESOURCE: 1}, env={_DEVICES_VARIABLE: ",".join(devices)}, preload=[__name__],
        silence_logs=logging.CRITICAL,
    )


_DEVICES_VARIABLE = "PHYRADGS_LOCAL_WORKERS"


def dask_setup(worker: Any) -> None:
    """Dask calls this when a local worker starts: it takes its device, by its number, and ignores Ctrl-C. In a terminal
    Ctrl-C reaches every process; the sweep answers it."""
    devices = os.environ[_DEVICES_VARIABLE].split(",")
    os.environ[DEVICE_VARIABLE] = devices[int(worker.name) % len(devices)]
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def has_dask() -> bool:
    return importlib.util.find_spec("distributed") is not None


def distributed() -> ModuleType:
    """Imports dask.distributed and silences its log; InputError says how to install it."""
    use = "the package that --scheduler and --workers need"
    package = checks.package("distributed", use, "phyradgs-cl[cluster]")
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)
    return package


@functools.cache
def runtime_of_process(device: str | None = None) -> Runtime:
    """Returns this process's runtime on a device; None is PHYRADGS_DEVICE's. Built kernels stay from run to run.
    ``runtime_of_process.cache_clear()`` makes the next run open its device again, after a failure of the device."""
    return Runtime(device)
