"""Runs shared out over Dask's workers, no more than there are devices, and a run that kills workers takes no other along."""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phyradgs_cl.cluster.local import RESOURCE, distributed, local_cluster
from phyradgs_cl.cluster.workers import Workers
from phyradgs_cl.errors import DeviceError, InputError

_LOOK_EVERY_S, _CONNECT_S = 0.2, 10.0
_WITHOUT_WORKERS_S, _REVIVALS = 20.0, 3
# asyncio.TimeoutError is another class up to Python 3.10
_NO_ANSWER = (TimeoutError, asyncio.TimeoutError, CancelledError, OSError)
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PoolState:
    """How many runs wait and are at workers, and how many devices the workers have."""

    waiting: int
    running: int
    devices: int


@dataclass(frozen=True)
class Lost:
    """A run whose workers died, as often as Dask allows (``distributed.scheduler.allowed-failures``)."""

    reason: str


class Pool:
    """The workers, as a context: entered, they are there or on their way; left, local ones end."""

    def __init__(self, workers: Workers) -> None:
        self.workers = workers
        self._cluster: Any = None
        self._client: Any = None

    def __enter__(self) -> "Pool":
        distributed()
        try:
            if self.workers.is_local:
                self._cluster = local_cluster(self.workers)
            self._client = self._connected()
        except (RuntimeError, ValueError, *_NO_ANSWER) as error:  # ValueError: no address, or no JSON
            found = f"no answer ({str(error) or type(error).__name__})"
            if self.workers.is_local:
                remedy = "try fewer --workers"
                raise DeviceError("local workers", found, "processes that stay", remedy) from error
            expected = "the address of a Dask scheduler that runs, or its scheduler file"
            raise InputError(self._subject, found, expected, "start one with 'dask scheduler'") from error
        return self

    def __exit__(self, *_: object) -> None:
        for part in (self._client, self._cluster):
            if part is not None:
                part.close(timeout=_CONNECT_S)

    @property
    def dashboard(self) -> str:
        """The address of Dask's own page about the workers; empty where there is none."""
        return str(self._client.dashboard_link or "")

    def results(
        self,
        function: Callable[[Any], Any],
        arguments: Mapping[str, Any],
        look: Callable[[PoolState], None] = lambda state: None,
    ) -> Iterator[tuple[str, Any]]:
        """(name, ``function(argument)`` or Lost) of every argument once, as they come; ``look`` is called some times a
        second. An exception of ``function`` is raised here and ends the others. InputError when the scheduler goes away."""
        waiting, running = deque(arguments), dict[Any, str]()
        seen_s, revivals = time.monotonic(), 0
        try:
            while waiting or running:
                devices = self._devices()
                if devices:
                    seen_s = time.monotonic()
                elif time.monotonic() - seen_s > _WITHOUT_WORKERS_S:
                    if self.workers.is_local:
                        revivals += 1
                        self._revive(revivals)
                        waiting.extendleft(running.values())
                        running.clear()
                    else:
                        start = f"dask worker {self.workers.scheduler} --nthreads 1 --resources {RESOURCE}=1"
                        log.warning("no worker with the resource %s: waiting for one ('%s')", RESOURCE, start)
                    seen_s = time.monotonic()
                while waiting and len(running) < devices:
                    name = waiting.popleft()
                    key = f"{name}-{time.time_ns():x}"  # of this call alone: no earlier result is taken for it
                    how = {"key": key, "resources": {RESOURCE: 1}, "pure": False}
                    running[self._client.submit(function, arguments[name], **how)] = name
                look(PoolState(len(waiting), len(running), devices))
                for future in self._finished(running):
                    revivals = 0
                    yield running.pop(future), self._outcome(future)
        finally:
            if self._client.status == "running":
                self._client.cancel(list(running))

    def _finished(self, running: Mapping[Any, str]) -> set[Any]:
        if not running:
            time.sleep(_LOOK_EVERY_S)
            return set()
        try:
            options = {"timeout": _LOOK_EVERY_S, "return_when": "FIRST_COMPLETED"}
            with self._client.as_current():
                return set(distributed().wait(list(running), **options).done)
        except (TimeoutError, asyncio.TimeoutError):
            return set()
        except CancelledError as error:
            raise self._scheduler_gone() from error

    def _outcome(self, future: Any) -> Any:
        try:
            return future.result(timeout=_CONNECT_S)
        except distributed().KilledWorker as error:
            return Lost(f"{error.allowed_failures + 1} workers died at it")
        except ImportError as error:
            expected, remedy = "the phyradgs-cl of this process", "install the same version there"
            raise InputError("a worker", str(error), expected, remedy) from error
        except _NO_ANSWER as error:
            if future.status == "error":
                raise
            raise self._scheduler_gone() from error

    # --- the scheduler --------------------------------------------------------------------------------

    @property
    def _subject(self) -> str:
        return "local workers" if self.workers.is_local else f"--scheduler {self.workers.scheduler}"

    def _connected(self) -> Any:
        package, scheduler = distributed(), self.workers.scheduler
        if self._cluster is not None:
            return package.Client(self._cluster, timeout=_CONNECT_S, set_as_default=False)
        is_file = scheduler.endswith(".json")
        if is_file and not Path(scheduler).is_file():  # Dask would wait for it without a word
            raise FileNotFoundError("no such file")
        where = {"scheduler_file": scheduler} if is_file else {"address": scheduler}
        return package.Client(**where, timeout=_CONNECT_S, set_as_default=False)

    def _devices(self) -> int:
        try:
            workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        except _NO_ANSWER as error:
            raise self._scheduler_gone() from error
        if self._client.status != "running":
            raise self._scheduler_gone()
        return sum(int(worker.get("resources", {}).get(RESOURCE, 0)) for worker in workers)

    def _scheduler_gone(self) -> InputError:
        return InputError(self._subject, "gone", "a scheduler", "start it, and repeat the command to go on")

    def _revive(self, times: int) -> None:
        """A nanny whose worker was killed as it started does not try again."""
        if times > _REVIVALS:
            raise DeviceError(self._subject, "all gone", "processes that stay", "try fewer --workers")
        log.warning("no local worker is left: starting them anew")
        self.__exit__()
        self.__enter__()
