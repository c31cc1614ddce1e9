"""What a watched folder's scans have become: volumes, errors, and work that was interrupted."""

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from phyradgs_cl.io import checkpoint_path, former_checkpoint_path, partial_path, written_beside
from phyradgs_cl.io.output import beside
from phyradgs_cl.text import plain_text
from phyradgs_cl.workflow.watch.arrivals import Arrival

WORK = ".work"


@dataclass(frozen=True)
class Results:
    """The folder of volumes. What is under way lies in ``.work``, so that a volume that is there is whole."""

    folder: Path

    def sweep_up(self) -> None:
        """Removes what a killed run was writing: nobody else is at work here."""
        for path in (self.folder / WORK).glob(".*.part"):
            with suppress(OSError):
                path.unlink()

    def volume(self, scan: Path) -> Path:
        return self.folder / f"{scan.stem}.h5"

    def work(self, scan: Path) -> Path:
        return self.folder / WORK / f"{scan.stem}.h5"

    def error(self, scan: Path) -> Path:
        return beside(self.folder / scan.stem, ".error.txt")

    def is_settled(self, arrival: Arrival) -> bool:
        """Whether there is a volume, or an error about the file as it is."""
        if self.volume(arrival.path).exists():
            return True
        try:
            text = self.error(arrival.path).read_text(encoding="utf-8")
        except (OSError, UnicodeError):
            return False
        return text.endswith(_version(arrival))

    def start(self, scan: Path) -> Path:
        """The file to write; a part of an earlier run is gone, its checkpoint is not."""
        self.work(scan).unlink(missing_ok=True)
        return self.work(scan)

    def publish(self, scan: Path) -> None:
        """The volume appears, and what was said about an earlier failure goes."""
        os.replace(self.work(scan), self.volume(scan))
        for path in (self.error(scan), *self._checkpoints(scan)):
            path.unlink(missing_ok=True)

    def discard(self, scan: Path) -> None:
        """Nothing is left of a run."""
        for path in (self.work(scan), partial_path(self.work(scan)), *self._checkpoints(scan)):
            path.unlink(missing_ok=True)

    def set_aside(self, arrival: Arrival, message: str) -> None:
        """Writes why there is no volume, with the file's size and time: it is tried again when they change."""
        self.discard(arrival.path)
        text = f"{plain_text(message)}\n\nThe scan is tried again when it changes, or when this file is removed.\n"
        text += _version(arrival)
        work = beside(self.work(arrival.path), ".txt")
        with written_beside(work) as temporary:
            temporary.write_text(text, encoding="utf-8")
        os.replace(work, self.error(arrival.path))

    def _checkpoints(self, scan: Path) -> list[Path]:
        return [checkpoint_path(self.work(scan)), former_checkpoint_path(self.work(scan))]


def _version(arrival: Arrival) -> str:
    return f"bytes {arrival.size_bytes}, mtime_ns {arrival.mtime_ns}\n"
