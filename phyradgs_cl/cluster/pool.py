"""Runs shared out over workers: each is at one worker at a time, lost workers' runs are made again.

No more is handed out than there are devices free. What waits, waits here: so a run counts the deaths of workers that it was
itself at, a new worker gets work at once, and when the scheduler is lost, nothing is that cannot be handed out again.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from phyradgs_cl.cluster.library import distributed
from phyradgs_cl.cluster.local import RESOURCE, local_cluster
from phyradgs_cl.cluster.workers import Workers
from phyradgs_cl.errors import DeviceError, InputError

_LOOK_EVERY_S, _COUNT_EVERY_S, _SAY_EVERY_S = 0.05, 0.5, 60.0
_CONNECT_S, _RECONNECT_S, _GATHER_S = 10.0, 600.0, 30.0
_REVIVE_S, _STARTS = 20.0, 3
_TEMPORARY = (
    TimeoutError,
    asyncio.TimeoutError,
    CancelledError,
    OSError,
)  # up to Python 3.10 the first two differ
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
        self._numbers = count()
        self._addresses: set[str] = set()
        self._devices = 0
        self._counted_s, self._said_s, self._seen_s = 0.0, -_SAY_EVERY_S, time.monotonic()

    def __enter__(self) -> Pool:
        distributed()
        if self.workers.is_local:
            self._cluster = self._started()
        try:
            self._client = self._connected()
        except _TEMPORARY as error:
            expected = "the address of a Dask scheduler that runs, or its scheduler file"
            remedy = "start one with 'dask scheduler'"
            found = f"no answer ({_reason(error)})"
            raise InputError(f"--scheduler {self.workers.scheduler}", found, expected, remedy) from error
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
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
        """(name, ``function(argument)`` or Lost) of every argument once, as they come.

        An exception of ``function`` is raised here; the other runs are then given up. ``look`` is called some times a
        second. Raises InputError when the scheduler has been gone for ten minutes.
        """
        waiting, running = deque(arguments), dict[str, Any]()
        try:
            while waiting or running:
                self._keep_connection()
                self._count_devices(bool(running))
                while waiting and len(running) < self._devices and self._client.status == "running":
                    name = waiting.popleft()
                    running[name] = self._submitted(function, arguments[name], name)
                for name, future in list(running.items()):
                    if future.client is not self._client or future.status in ("cancelled", "lost"):
                        # the scheduler went away, which is not the run's fault
                        del running[name]
                        waiting.appendleft(name)
                    elif future.done() and (found := self._outcome(future)) is not None:
                        del running[name]
                        yield name, found
                look(PoolState(len(waiting), len(running), self._devices))
                time.sleep(_LOOK_EVERY_S)
        finally:
            for future in running.values():
                future.release()

    def _submitted(self, function: Callable[[Any], Any], argument: Any, name: str) -> Any:
        """A future under a key of its own, so that no result of an earlier scheduler is taken for this one's."""
        key = f"{name}-{time.time_ns():x}-{next(self._numbers)}"
        return self._client.submit(function, argument, key=key, resources={RESOURCE: 1}, pure=False)

    def _outcome(self, future: Any) -> Any:
        """A result; None if it was lost on its way, which its status will say."""
        if future.status == "error":
            error = future.exception(timeout=_GATHER_S)
            if isinstance(error, distributed().KilledWorker):
                return Lost(f"{error.allowed_failures + 1} workers died at it")
            if isinstance(error, ImportError):
                expected, remedy = "the phyradgs-cl of this process", "install the same version there"
                raise InputError("a worker", str(error), expected, remedy)
            raise error
        try:
            return future.result(timeout=_GATHER_S)
        except _TEMPORARY:
            return None

    # --- the scheduler --------------------------------------------------------------------------------

    def _started(self) -> Any:
        """Local workers; a process that ends while it starts ends them all, and they are started again."""
        for _ in range(_STARTS):
            try:
                return local_cluster(self.workers)
            except (RuntimeError, *_TEMPORARY) as error:
                reason = _reason(error)
        remedy = "try fewer --workers"
        raise DeviceError("local workers", f"that do not start ({reason})", "processes that stay", remedy)

    def _revive(self) -> None:
        """A nanny whose worker was killed as it started does not try again."""
        log.warning("no local worker is left: starting them anew")
        self._close()
        self._cluster = self._started()
        self._client = self._connected()

    def _connected(self) -> Any:
        package, scheduler = distributed(), self.workers.scheduler
        if self._cluster is not None:
            return package.Client(self._cluster, timeout=_CONNECT_S, set_as_default=False)
        is_file = scheduler.endswith(".json")
        if is_file and not Path(scheduler).is_file():  # Dask would wait for it without a word
            raise FileNotFoundError("no such file")
        where = {"scheduler_file": scheduler} if is_file else {"address": scheduler}
        try:
            return package.Client(**where, timeout=_CONNECT_S, set_as_default=False)
        except ValueError as error:  # no address at all, or no JSON
            raise OSError(str(error)) from error

    def _keep_connection(self) -> None:
        """Waits for a scheduler that went away; its runs then count as cancelled."""
        if self._client.status == "running":
            return
        log.warning("the scheduler %s is gone: waiting for it", self.workers.scheduler)
        deadline = time.monotonic() + _RECONNECT_S
        while self._client.status != "running":
            if time.monotonic() > deadline:
                found = f"gone for {_RECONNECT_S / 60:.0f} minutes"
                remedy = "start it, and repeat the command to go on"
                raise InputError(f"--scheduler {self.workers.scheduler}", found, "a scheduler", remedy)
            if self._client.status == "closed":
                with suppress(*_TEMPORARY):
                    self._client = self._connected()
            time.sleep(_LOOK_EVERY_S)
        self._addresses, self._devices, self._counted_s = set(), 0, 0.0
        log.warning("the scheduler %s is back: going on", self.workers.scheduler)

    def _count_devices(self, is_busy: bool) -> None:
        now = time.monotonic()
        if now - self._counted_s < _COUNT_EVERY_S:
            return
        self._counted_s = now
        try:
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
        except _TEMPORARY:
            return
        able = {name: int(w.get("resources", {}).get(RESOURCE, 0)) for name, w in workers.items()}
        addresses = {name for name, devices in able.items() if devices > 0}
        for gone in sorted(self._addresses - addresses) if is_busy else ():
            log.warning("worker %s is gone: its run is made again", gone)
        self._addresses, self._devices = addresses, sum(able.values())
        if self._devices > 0:
            self._seen_s = now
        elif self.workers.is_local:
            if now - self._seen_s > _REVIVE_S:
                self._revive()
                self._seen_s = time.monotonic()
        elif now - self._said_s > _SAY_EVERY_S:
            self._said_s = now
            start = f"dask worker {self.workers.scheduler} --nthreads 1 --resources {RESOURCE}=1"
            log.warning("no worker with the resource %s: waiting for one ('%s')", RESOURCE, start)


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__
