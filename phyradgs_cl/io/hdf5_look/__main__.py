"""Opens HDF5 files as their names come on standard input, and answers "done" or "large" for each that it survives.

python FOLDER SMALL_BYTES MOST_OBJECTS MOST_MEMORY_BYTES CPU_SECONDS. Every object is opened, every attribute read and every
dataset of at most SMALL_BYTES; limits of the system end the process that takes more memory, or longer with one file.
Nothing of phyradgs_cl is imported, and nothing that takes long to start.
"""

from __future__ import annotations

import json
import sys
import time

import h5py

try:
    import resource
except ImportError:  # not POSIX: nothing bounds this process but the clock of whoever started it
    resource = None  # type: ignore[assignment]

_DAMAGE = (OSError, RuntimeError, LookupError, ValueError, TypeError, MemoryError)
"""What h5py raises for damage that HDF5 survives; it is met again, and named, by the reading itself."""
_LARGE = 1 / 32  # of the memory that may be had: more than headers ever need


class Look:
    """A walk through one file that ends after so many objects."""

    def __init__(self, small_bytes: int, most_objects: int) -> None:
        self._small_bytes, self._left = small_bytes, most_objects

    def at_file(self, path: str) -> None:
        try:
            with h5py.File(path, "r") as file:
                self._at(file)
        except _DAMAGE:
            return

    def _at(self, thing: h5py.Group | h5py.Dataset) -> None:
        self._left -= 1
        if self._left < 0:
            return
        try:
            for name in thing.attrs:
                thing.attrs[name]
            if isinstance(thing, h5py.Dataset):
                if self._is_small(thing):
                    thing[()]
                return
            for name in thing:
                if isinstance(thing.get(name, getlink=True), h5py.HardLink):
                    self._at(thing[name])
        except _DAMAGE:
            return

    def _is_small(self, dataset: h5py.Dataset) -> bool:
        fixed = dataset.dtype.kind != "O" or dataset.size == 1
        return (
            fixed and not dataset.is_virtual and not dataset.external and dataset.nbytes <= self._small_bytes
        )


def held_bytes() -> int:
    """The most memory that this process has held; 0 where the system does not say."""
    try:  # in Linux the system's call would also tell what the process held that started this one
        with open("/proc/self/status") as status:
            return 1024 * int(status.read().partition("VmHWM:")[2].split()[0])
    except (OSError, ValueError, IndexError):
        pass
    if resource is None:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def limit(what: str, to: int) -> None:
    """Bounds this process by a limit of ``resource``, where the system has one."""
    if resource is not None:
        kind = getattr(resource, what)
        most = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (to if most < 0 else min(to, most), most))


def answer(word: str) -> None:
    sys.stdout.write(word + "\n")
    sys.stdout.flush()


def main() -> None:
    small_bytes, most_objects, most_memory_bytes, cpu_seconds = map(int, sys.argv[1:])
    limit("RLIMIT_CORE", 0)
    limit("RLIMIT_AS", most_memory_bytes)
    start_bytes = held_bytes()
    answer("ready")
    for line in sys.stdin:
        limit("RLIMIT_CPU", int(time.process_time()) + 1 + cpu_seconds)
        Look(small_bytes, most_objects).at_file(json.loads(line))
        answer("large" if held_bytes() - start_bytes > _LARGE * most_memory_bytes else "done")


if __name__ == "__main__":
    main()
