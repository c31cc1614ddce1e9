"""Writes the page of a run under way, whole and every few seconds. After the run it becomes the report."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from phyradgs_cl.errors import PhyradgsError
from phyradgs_cl.io import written_beside
from phyradgs_cl.reconstructors import Progress
from phyradgs_cl.reconstructors.projected import FramePair
from phyradgs_cl.report.live_page import Snapshot, Status, live_page

EVERY_S = 5.0
SHARE = 0.01  # pictures may cost the run this fraction of its time
FRAMES = 2
FRAMES_FROM_S = 60.0  # no frames are computed in runs expected to be shorter: their report comes soon
log = logging.getLogger(__name__)


class LivePage:
    """Writes a page about a running method, to which it listens. It is a context around the run.

    A thread writes the page every ``every_s`` seconds, so an older page belongs to a run that was killed. Pictures are taken
    between two iterations, as long as their time is below ``SHARE`` of the run's. An error, or Ctrl-C, leaves its reason on
    the page. A file that was there before is replaced from the first iteration on, so a refused run leaves it alone. A page
    that cannot be written is one warning, and no error."""

    def __init__(self, path: Path, title: str, settings: Mapping[str, object], every_s: float = EVERY_S) -> None:
        self.path, self.every_s = path, every_s
        self.status = Status(title, settings, every_s, time.time())
        self.spent_s = 0.0
        """The time in s that the run has waited for pictures."""
        self._pictured_s = -every_s
        self._waits = False  # true until the first iteration
        self._started_s = time.monotonic()
        self._is_over = threading.Event()
        self._writer = threading.Thread(target=self._keep_writing, name="live page", daemon=True)
        self._warnings: set[str] = set()

    def __enter__(self) -> "LivePage":
        self._waits = self.path.exists()
        if not self._waits:
            self._begin()
        return self

    def _begin(self) -> None:
        self._waits = False
        self._write()
        self._writer.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None:
            self.end("The run is complete.", is_complete=True)
        elif self._waits:
            return
        self.end(f"Stopped by an error: {error}" if isinstance(error, Exception) else "Interrupted.")

    def stage(self, text: str) -> None:
        """Says on the page what the run does before its first iteration."""
        self.status = replace(self.status, stage=text)

    def __call__(self, progress: Progress) -> None:
        self.status = self.status.after(progress, time.time())
        if self._waits:
            self._begin()
        used_s = time.monotonic() - self._started_s
        if progress.volume is None or used_s - self._pictured_s < self.every_s or self.spent_s > SHARE * used_s:
            return
        self.status = replace(self.status, snapshot=self._snapshot(progress, used_s))
        self._pictured_s = time.monotonic() - self._started_s
        self.spent_s += self._pictured_s - used_s

    def end(self, reason: str, is_complete: bool = False) -> None:
        """Writes the page a last time, with the reason why no more news will come. Later calls do nothing."""
        if not self._is_over.is_set():
            self._stop()
            self.status = replace(self.status, ended=reason, is_complete=is_complete)
            self._write()

    def become(self, write_report: Callable[[Path], object]) -> None:
        """Replaces the page by the report that ``write_report`` writes. Where that fails, the page says how to make it."""
        self.stage("Writing the report")
        try:
            write_report(self.path)
            self._stop()
        except PhyradgsError as error:
            self._warn(f"no report: {error}")
            self.end("The run is complete. 'phyradgs report' makes its report.", is_complete=True)

    def _snapshot(self, progress: Progress, used_s: float) -> Snapshot:
        """Returns the present slices and frames. Frames that the device cannot compute are left out."""
        assert progress.volume is not None
        frames: list[FramePair] = []
        expected_s = used_s * progress.iterations / max(progress.iteration, 1)
        if progress.frames is not None and expected_s >= FRAMES_FROM_S:
            try:
                frames = progress.frames(FRAMES)
            except PhyradgsError as error:
                self._warn(f"no frames on the live page: {error}")
        return Snapshot.of(progress.iteration, *progress.volume(), frames)

    def _keep_writing(self) -> None:
        while not self._is_over.wait(self.every_s):
            self._write()

    def _stop(self) -> None:
        self._is_over.set()
        if self._writer.is_alive():
            self._writer.join()

    def _write(self) -> None:
        try:
            page = live_page(self.status, time.time())
            with written_beside(self.path) as temporary:
                temporary.write_text(page, encoding="utf-8")
        except PhyradgsError as error:
            self._warn(f"no live page: {error}")

    def _warn(self, message: str) -> None:
        if message not in self._warnings:
            log.warning("%s", message)
        self._warnings.add(message)
