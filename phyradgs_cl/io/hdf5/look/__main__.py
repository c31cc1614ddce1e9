"""Looks at one HDF5 file within limits: python FOLDER FILE SMALL_BYTES MOST_OBJECTS MEMORY_BYTES CPU_SECONDS SECONDS.

Opens every object, reads every attribute and every dataset of at most SMALL_BYTES. Ends with status 0, with LARGE where that
took more memory than headers need, or by the signal of a limit or a crash. Imports nothing of phyradgs_cl, and nothing slow.
"""

import signal
import sys
import time

import h5py

try:
    import resource
except ImportError:  # not POSIX: nothing bounds this process but the clock of whoever started it
    resource = None  # type: ignore[assignment]

LARGE = 100
_DAMAGE = (OSError, RuntimeError, LookupError, ValueError, TypeError, MemoryError)
"""What h5py raises for damage that HDF5 survives; it is met again, and named, by the reading itself."""
_SLACK = 32  # of headers' memory: what asks for too much must still get it, to be noticed
_UNFOLDED_BYTES = 64 << 20  # for a small dataset, whatever its filters make of it


def look(
    path: str, small_bytes: int, most_objects: int, memory_bytes: int, cpu_seconds: int, seconds: float
) -> int:
    """The status to end with. Limits of the system end this process where it takes too long."""
    limit("RLIMIT_CORE", 0)
    limit("RLIMIT_CPU", int(time.process_time()) + 1 + cpu_seconds)
    start_bytes = in_use_bytes("VmHWM:")
    limit_memory(_SLACK * memory_bytes)
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, seconds)
    _Walk(small_bytes, most_objects, _SLACK * memory_bytes).through(path)
    return LARGE if in_use_bytes("VmHWM:") - start_bytes > memory_bytes else 0


class _Walk:
    """A walk through one file that ends after so many objects."""

    def __init__(self, small_bytes: int, most_objects: int, memory_bytes: int) -> None:
        self._small_bytes, self._left, self._memory_bytes = small_bytes, most_objects, memory_bytes

    def through(self, path: str) -> None:
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
                    limit_memory(_UNFOLDED_BYTES)
                    thing[()]
                return
            for name in thing:
                if isinstance(thing.get(name, getlink=True), h5py.HardLink):
                    self._at(thing[name])
        except _DAMAGE:
            return
        finally:
            if isinstance(thing, h5py.Dataset):
                limit_memory(self._memory_bytes)

    def _is_small(self, dataset: h5py.Dataset) -> bool:
        fixed = dataset.dtype.kind != "O" or dataset.size == 1
        return (
            fixed and not dataset.is_virtual and not dataset.external and dataset.nbytes <= self._small_bytes
        )


def in_use_bytes(what: str) -> int:
    """Memory of this process as Linux counts it: VmHWM, the most that it has held, or VmSize; 0 elsewhere."""
    try:
        with open("/proc/self/status") as status:
            return 1024 * int(status.read().partition(what)[2].split()[0])
    except (OSError, ValueError, IndexError):
        return 0


def limit_memory(more_bytes: int) -> None:
    """Bounds what this process may take from now on, where Linux counts."""
    in_use = in_use_bytes("VmSize:")
    if in_use:
        limit("RLIMIT_AS", in_use + more_bytes)


def limit(what: str, to: int) -> None:
    """Bounds this process by a limit of ``resource``, where the system has one."""
    if resource is not None:
        kind = getattr(resource, what)
        most = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (to if most < 0 else min(to, most), most))


if __name__ == "__main__":
    file, small, most, memory, cpu, last = sys.argv[1:]
    sys.exit(look(file, int(small), int(most), int(memory), int(cpu), float(last)))
