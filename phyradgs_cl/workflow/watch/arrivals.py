"""Which files of a folder are complete, by looking again: network file systems send no notice of others' writes."""

import os
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

_SUFFIX = ".h5"
# Elsewhere ctime is when a file was made.
_HAS_CHANGE_TIME = os.name == "posix"


@dataclass(frozen=True)
class Arrival:
    """A file that nobody seems to write any more, as it is now."""

    path: Path
    size_bytes: int
    mtime_ns: int

    def is_unchanged(self) -> bool:
        """Whether the file is still the one that arrived."""
        try:
            found = self.path.stat()
        except OSError:
            return False
        return (found.st_size, found.st_mtime_ns) == (self.size_bytes, self.mtime_ns)


class Arrivals:
    """Looks at a folder. A file is complete when its size and times have stood still for ``settle_s``; at once where it
    was renamed into place, or copied with its times kept: then its last change (ctime) is later than its last byte
    (mtime), both by the file server's clock."""

    def __init__(self, folder: Path, settle_s: float, now: Callable[[], float] = time.monotonic) -> None:
        self.folder, self.settle_s, self._now = folder, settle_s, now
        self._since: dict[Path, tuple[tuple[int, int, int], float]] = {}

    def look(self) -> list[Arrival]:
        """The complete scans, the oldest first. Raises OSError where the folder cannot be read."""
        now, since = self._now(), {}
        complete = []
        for path, found in self._files():
            version = (found.st_size, found.st_mtime_ns, found.st_ino)
            before = self._since.get(path)
            since[path] = before if before is not None and before[0] == version else (version, now)
            is_finished = _HAS_CHANGE_TIME and found.st_ctime_ns > found.st_mtime_ns and found.st_size > 0
            if is_finished or now - since[path][1] >= self.settle_s:
                complete.append(Arrival(path, found.st_size, found.st_mtime_ns))
        self._since = since
        return sorted(complete, key=lambda arrival: (arrival.mtime_ns, arrival.path.name))

    def _files(self) -> list[tuple[Path, os.stat_result]]:
        files = []
        with os.scandir(self.folder) as entries:
            for entry in entries:
                if not entry.name.endswith(_SUFFIX) or entry.name.startswith("."):
                    continue
                try:
                    found = os.stat(entry.path)
                except OSError:  # gone since, or a link to nowhere
                    continue
                if stat.S_ISREG(found.st_mode):
                    files.append((Path(entry.path), found))
        return files
