"""New HDF5 files whose writing may fail without the HDF5 library hearing of it.

On a full disk the library leaves objects that it cannot close, and crashes at the latest when the process ends. So it
writes through a file of ours that takes everything; what went wrong is raised afterwards.
"""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import h5py


@contextmanager
def new_hdf5(path: str | Path) -> Iterator[h5py.File]:
    """A new file at ``path``, or in place of what is there; OSError at the end if not all of it could be written."""
    with open(path, "w+b", buffering=0) as raw:
        taking = _TakesEverything(raw)
        try:
            with h5py.File(taking, "w") as file:
                yield file
        finally:
            if taking.error is not None:  # whatever the library made of it
                raise taking.error


class _TakesEverything(io.RawIOBase):
    """A file that accepts all writes; after the first that fails, nothing reaches the disk."""

    def __init__(self, raw: BinaryIO) -> None:
        self._raw = raw
        self._at = self._end = 0
        self.error: OSError | None = None

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._end}[whence]
        return self._at

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """What was written; zeros where that was lost."""
        view = memoryview(buffer).cast("B")
        self._raw.seek(self._at)
        count = self._raw.readinto(view) or 0  # type: ignore[attr-defined]
        view[count:] = bytes(len(view) - count)
        self._at += len(view)
        return len(view)

    def write(self, data: memoryview) -> int:  # type: ignore[override]
        view = memoryview(data).cast("B")
        try:
            if self.error is None:
                self._write_all(view)
        except OSError as error:
            self.error = error
        self._at += len(view)
        self._end = max(self._end, self._at)
        return len(view)

    def _write_all(self, view: memoryview) -> None:
        self._raw.seek(self._at)
        written = 0
        while written < len(view):  # an unbuffered file, a disk that fills up, may take a part
            written += self._raw.write(view[written:])

    def truncate(self, size: int | None = None) -> int:
        self._end = self._at if size is None else size
        try:
            if self.error is None:
                self._raw.truncate(self._end)
        except OSError as error:
            self.error = error
        return self._end
