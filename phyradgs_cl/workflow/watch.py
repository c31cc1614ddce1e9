"""Reconstructs the scans of a folder as they arrive, each once. Its only state is the files that it writes. The folder is
polled: network file systems send no notice of files that other machines write."""

import logging
import os
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from phyradgs_cl import checks, signals
from phyradgs_cl.errors import DeviceError, InputError, OutOfMemoryError, OutputError, PhyradgsError
from phyradgs_cl.io import checkpoint_path, former_checkpoint_path, only_run, partial_path, written_beside
from phyradgs_cl.io.hdf5.source import BEING_WRITTEN
from phyradgs_cl.io.output import beside, make_folder
from phyradgs_cl.reconstructors import ProgressReport, Reconstruction, RunPlan, ignore_progress
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.text import plain_text
from phyradgs_cl.workflow.reconstruct import check_interval, is_complete, resume_or_restart

_LOCK = "watch"
_WORK = ".work"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class WatchJob:
    """The watched folder, and the plan by which its scans are reconstructed into ``output``. poll_s: seconds between two
    looks at the folder. settle_s: how long a file must not have changed. once: return when every complete scan has its
    volume or its error."""

    folder: Path
    output: Path
    plan: RunPlan
    poll_s: float = 2.0
    settle_s: float = 5.0
    once: bool = False
    checkpoint_every_s: float = 600.0

    def __post_init__(self) -> None:
        checks.within("--poll-s", self.poll_s, 0.01, 86_400)
        checks.within("--settle-s", self.settle_s, 0, 86_400)
        check_interval(self.checkpoint_every_s)


@dataclass(frozen=True)
class WatchEvent:
    """A scan that has become a volume, with its metrics, or that has failed with ``error``."""

    scan: Path
    result: Reconstruction | None = None
    metrics: dict[str, float] | None = None
    error: str = ""


def run_watch(
    job: WatchJob, make_runtime: Callable[[], Runtime], tell: Callable[[WatchEvent], None],
    report: Callable[[Path], ProgressReport] = lambda scan: ignore_progress,
) -> None:
    """Looks, reconstructs, and looks again; returns only with ``once``. A signal ends the run after its present iteration,
    as KeyboardInterrupt, with a checkpoint for the next start. Raises InputError for a missing folder, or one that is also
    the output; OutputError where nothing can be written, BusyError while another watch writes there; DeviceError where there
    is no device, or none any more."""
    if not job.folder.is_dir():
        raise InputError(str(job.folder), "no folder", "the folder in which scans arrive", "make it first")
    if job.folder.resolve() == job.output.resolve():
        raise InputError("-o", "the watched folder itself", "another folder for the volumes", "choose another -o")
    make_folder(job.output / _WORK, job.output)
    with only_run(job.output / _LOCK):
        for path in (job.output / _WORK).glob(".*.part"):  # of a killed watch: this one is alone
            with suppress(OSError):
                path.unlink()
        _Watch(job, make_runtime, tell, report).run()


@dataclass(frozen=True)
class Arrival:
    """A file that no program seems to be writing, with its size and time."""

    path: Path
    size_bytes: int
    mtime_ns: int

    def is_unchanged(self) -> bool:
        """True while the file has the same size and time."""
        try:
            status = self.path.stat()
        except OSError:
            return False
        return (status.st_size, status.st_mtime_ns) == (self.size_bytes, self.mtime_ns)

    @property
    def version(self) -> str:
        """The last line of the scan's error file."""
        return f"bytes {self.size_bytes}, mtime_ns {self.mtime_ns}\n"


class Arrivals:
    """Finds the complete scans of a folder. A file is complete when its size and times have not changed for ``settle_s``. A
    file that was renamed into place, or copied with its times, is complete at once: its last change (ctime) is later than
    its last byte (mtime), both by the clock of the file server."""

    def __init__(self, folder: Path, settle_s: float, now: Callable[[], float] = time.monotonic) -> None:
        self.folder, self.settle_s, self._now = folder, settle_s, now
        self._seen: dict[Path, tuple[tuple[int, int, int], float]] = {}
        """Of every file (size, time, inode), and since when."""

    def look(self) -> list[Arrival]:
        """Returns the complete scans, the oldest first. Raises OSError where the folder cannot be read."""
        now, seen, complete = self._now(), {}, []
        for path, status in self._files():
            version = (status.st_size, status.st_mtime_ns, status.st_ino)
            before = self._seen.get(path)
            seen[path] = before if before is not None and before[0] == version else (version, now)
            has_moved = os.name == "posix" and status.st_ctime_ns > status.st_mtime_ns and status.st_size > 0
            if has_moved or now - seen[path][1] >= self.settle_s:
                complete.append(Arrival(path, status.st_size, status.st_mtime_ns))
        self._seen = seen
        return sorted(complete, key=lambda arrival: (arrival.mtime_ns, arrival.path.name))

    def _files(self) -> Iterator[tuple[Path, os.stat_result]]:
        """Yields the regular files with the suffix of scans."""
        for path in sorted(Path(name) for name in os.scandir(self.folder)):
            if path.suffix == ".h5" and not path.name.startswith("."):
                with suppress(OSError):  # removed in the meantime, or a broken link
                    status = path.stat()
                    if stat.S_ISREG(status.st_mode):
                        yield path, status


class _Watch:
    """The loop over the arriving scans. Work in progress lies in ``.work``, so that a volume is always complete."""

    def __init__(
        self, job: WatchJob, make_runtime: Callable[[], Runtime], tell: Callable[[WatchEvent], None],
        report: Callable[[Path], ProgressReport],
    ) -> None:
        self.job, self.tell, self.report = job, tell, report
        self.make_runtime, self.rt = make_runtime, make_runtime()
        self.arrivals = Arrivals(job.folder, job.settle_s)
        self.is_unreadable = False

    def run(self) -> None:
        last_s = time.monotonic()
        while True:
            pending = (arrival for arrival in self._look() if not self._has_result(arrival))
            if any([self._handle(arrival) for arrival in pending]):
                last_s = time.monotonic()
            elif self.job.once and time.monotonic() - last_s > self.job.settle_s:
                return
            else:
                time.sleep(self.job.poll_s)

    def _look(self) -> list[Arrival]:
        try:
            arrivals = self.arrivals.look()
        except OSError as error:
            if self.job.once:
                raise
            if not self.is_unreadable:  # a server that is away comes back
                log.warning("%s cannot be read (%s): waiting for it", self.job.folder, error.strerror)
            self.is_unreadable = True
            return []
        self.is_unreadable = False
        return arrivals

    def _handle(self, arrival: Arrival) -> bool:
        """Makes a scan's volume or its error; False for a file that another program has open, which waits. After a failure
        of the device it is opened again, once. An error of a missing device ends the watch."""
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
        scan, work = arrival.path, self._work(arrival)
        work.unlink(missing_ok=True)  # of an earlier run, whose checkpoint stays
        try:
            every_s = self.job.checkpoint_every_s
            result, metrics = resume_or_restart(self.job.plan, scan, work, lambda: self.rt, self.report(scan), every_s)
        except signals.InterruptedAfterwards:  # the run had finished
            if work.exists() and not checkpoint_path(work).exists():
                self._publish(arrival)
            raise
        except (DeviceError, OutputError):  # the next scan would fail too
            raise
        except (PhyradgsError, MemoryError) as error:
            return self._fail(arrival, error)
        except Exception as error:  # a defect that one scan meets must not stop the others
            log.exception("%s", scan)
            return self._fail(arrival, error)
        if not is_complete(result):
            raise KeyboardInterrupt
        if self._publish(arrival):
            self.tell(WatchEvent(scan, result, metrics))
        return True

    def _publish(self, arrival: Arrival) -> bool:
        """Moves the volume to its place; False for a scan that has changed during its run, which is repeated."""
        with signals.finish_despite_interrupt():
            if not arrival.is_unchanged():
                log.warning("%s changed while it was reconstructed: once more when it is complete", arrival.path)
                self._discard(arrival)
                return False
            os.replace(self._work(arrival), self._volume(arrival))
            self._error(arrival).unlink(missing_ok=True)
            self._discard(arrival)
            return True

    def _fail(self, arrival: Arrival, error: BaseException) -> bool:
        """Writes the error file with the scan's size and time, so that the scan is tried again when they change."""
        if not arrival.is_unchanged() or BEING_WRITTEN in str(error):
            return False
        message = str(error) if isinstance(error, PhyradgsError) else f"{type(error).__name__}: {error}"
        text = f"{plain_text(message)}\n\nThe scan is tried again when it changes, or when this file is removed.\n"
        with signals.finish_despite_interrupt():
            self._discard(arrival)
            work = beside(self._work(arrival), ".txt")
            with written_beside(work) as temporary:
                temporary.write_text(text + arrival.version, encoding="utf-8")
            os.replace(work, self._error(arrival))
        self.tell(WatchEvent(arrival.path, error=message))
        return True

    def _has_result(self, arrival: Arrival) -> bool:
        """True if there is a volume, or an error about this version of the scan."""
        if self._volume(arrival).exists():
            return True
        try:
            return self._error(arrival).read_text(encoding="utf-8").endswith(arrival.version)
        except (OSError, UnicodeError):
            return False

    def _discard(self, arrival: Arrival) -> None:
        work = self._work(arrival)
        for path in (work, partial_path(work), checkpoint_path(work), former_checkpoint_path(work)):
            path.unlink(missing_ok=True)

    def _volume(self, arrival: Arrival) -> Path:
        return self.job.output / f"{arrival.path.stem}.h5"

    def _work(self, arrival: Arrival) -> Path:
        return self.job.output / _WORK / f"{arrival.path.stem}.h5"

    def _error(self, arrival: Arrival) -> Path:
        return beside(self.job.output / arrival.path.stem, ".error.txt")
