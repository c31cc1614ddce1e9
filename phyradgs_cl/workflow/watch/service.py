"""Reconstructs a folder's scans as they arrive. Its state is the files that it writes: it may be killed at any moment."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from phyradgs_cl import checks, signals
from phyradgs_cl.errors import DeviceError, InputError, OutOfMemoryError, OutputError, PhyradgsError
from phyradgs_cl.io import checkpoint_path, only_run
from phyradgs_cl.io.output import make_folder
from phyradgs_cl.reconstructors import ProgressReport, Reconstruction, ignore_progress
from phyradgs_cl.reconstructors.interrupt import finish_despite_interrupt
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.workflow.reconstruct import ReconstructionJob, go_on, is_whole
from phyradgs_cl.workflow.watch.arrivals import Arrival, Arrivals
from phyradgs_cl.workflow.watch.results import WORK, Results

_LOCK = "watch"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class WatchJob:
    """Which folder to watch, and how its scans are reconstructed into ``output``: as ``template``, but for its files.
    poll_s: between two looks at the folder. settle_s: how long a file must stand still. once: end when nothing is left."""

    folder: Path
    output: Path
    template: ReconstructionJob
    poll_s: float = 2.0
    settle_s: float = 5.0
    once: bool = False

    def __post_init__(self) -> None:
        checks.within("--poll-s", self.poll_s, 0.01, 86_400)
        checks.within("--settle-s", self.settle_s, 0, 86_400)


@dataclass(frozen=True)
class WatchEvent:
    """A scan that has become a volume (with its metrics), or was set aside with ``error``."""

    scan: Path
    result: Reconstruction | None = None
    metrics: dict[str, float] | None = None
    error: str = ""


def run_watch(
    job: WatchJob,
    make_runtime: Callable[[], Runtime],
    tell: Callable[[WatchEvent], None],
    report: Callable[[Path], ProgressReport] = lambda scan: ignore_progress,
) -> None:
    """Looks, reconstructs, looks again; returns only with ``once``. A signal during a run ends it after the iteration under
    way, as KeyboardInterrupt, with a checkpoint that the next start goes on from. InputError: no such folder, or it is also
    the output. OutputError: nothing can be written; BusyError while another watch has the output. DeviceError: no device,
    or none any more."""
    _check_folders(job)
    results = Results(job.output)
    make_folder(job.output / WORK, job.output)
    with only_run(job.output / _LOCK):
        results.sweep_up()
        _Watch(job, results, make_runtime, tell, report).run()


def _check_folders(job: WatchJob) -> None:
    if not job.folder.is_dir():
        raise InputError(str(job.folder), "no folder", "the folder in which scans arrive", "make it first")
    if job.folder.resolve() == job.output.resolve():
        remedy = "choose another -o"
        raise InputError("-o", "the watched folder itself", "a folder of its own for volumes", remedy)


class _Watch:
    def __init__(
        self,
        job: WatchJob,
        results: Results,
        make_runtime: Callable[[], Runtime],
        tell: Callable[[WatchEvent], None],
        report: Callable[[Path], ProgressReport],
    ) -> None:
        self.job, self.results, self.tell, self.report = job, results, tell, report
        self.make_runtime, self.rt = make_runtime, make_runtime()
        self.arrivals = Arrivals(job.folder, job.settle_s)
        self.is_unreadable = False

    def run(self) -> None:
        quiet_since_s = time.monotonic()
        while True:
            handled = False
            for arrival in self._look():
                if not self.results.is_settled(arrival):
                    handled |= self._handle(arrival)
            if handled:
                quiet_since_s = time.monotonic()
                continue
            if self.job.once and time.monotonic() - quiet_since_s > self.job.settle_s:
                return
            time.sleep(self.job.poll_s)

    def _look(self) -> list[Arrival]:
        try:
            found = self.arrivals.look()
        except OSError as error:
            if self.job.once:
                raise
            if not self.is_unreadable:  # a server that is away comes back
                log.warning("%s cannot be read (%s): waiting for it", self.job.folder, error.strerror)
            self.is_unreadable = True
            return []
        self.is_unreadable = False
        return found

    def _handle(self, arrival: Arrival) -> bool:
        """Makes the volume of a scan, or its error; False for a file that somebody has open, which waits. A device that
        fails is opened anew, once; if it is gone, that ends the watch."""
        try:
            return self._reconstruct(arrival)
        except OutOfMemoryError as error:
            return self._fail(arrival, error)
        except DeviceError as error:
            log.warning("%s: %s: trying again", arrival.path, error)
        self.rt = self.make_runtime()
        try:
            return self._reconstruct(arrival)
        except DeviceError as error:
            return self._fail(arrival, error)

    def _reconstruct(self, arrival: Arrival) -> bool:
        scan = arrival.path
        job = replace(self.job.template, scan=scan, output=self.results.start(scan))
        try:
            result, metrics = go_on(job, lambda: self.rt, self.report(scan))
        except signals.InterruptedAfterwards:  # the run had come to its end
            if self.results.work(scan).exists() and not checkpoint_path(self.results.work(scan)).exists():
                self._publish(arrival)
            raise
        except (DeviceError, OutputError):  # no fault of the scan's
            raise
        except (PhyradgsError, MemoryError) as error:
            return self._fail(arrival, error)
        except Exception as error:  # a defect that one scan meets must not keep the others waiting
            log.exception("%s", scan)
            return self._fail(arrival, error)
        if not is_whole(result):
            raise KeyboardInterrupt
        if self._publish(arrival):
            self.tell(WatchEvent(scan, result, metrics))
        return True

    def _publish(self, arrival: Arrival) -> bool:
        with finish_despite_interrupt():
            if arrival.is_unchanged():
                self.results.publish(arrival.path)
                return True
            log.warning("%s changed while it was reconstructed: once more when it is complete", arrival.path)
            self.results.discard(arrival.path)
            return False

    def _fail(self, arrival: Arrival, error: BaseException) -> bool:
        if not arrival.is_unchanged() or "unable to lock file" in str(error):  # HDF5 locks a file that it writes
            return False
        message = str(error) if isinstance(error, PhyradgsError) else f"{type(error).__name__}: {error}"
        with finish_despite_interrupt():
            self.results.set_aside(arrival, message)
        self.tell(WatchEvent(arrival.path, error=message))
        return True
