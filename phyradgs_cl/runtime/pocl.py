"""Makes PoCL (OpenCL on CPUs) fast and safe: sets its cache and threads, and the processor for which it builds kernels.

PoCL links each kernel with a library of built-in functions (fma, min, vload16, ...). PoCL's wheel has one such library for
each family of x86 processors. LLVM inlines a built-in only if the kernel's processor has all instruction sets of the
processor for which the library was built. PoCL 3.0 builds kernels for the processor that LLVM 14 takes the host for, which
may be wrong:

- LLVM's Ice Lake lacks the instruction CLWB of the library's processor. No built-in is inlined: kernels are 3 times slower.
- An unknown processor becomes "generic", for which no kernel builds (pocl/pocl issue 1049).
- Zen 4 is taken for a Zen 3 without AVX-512, and LLVM aborts ("Cannot select: i64 = fma").

PoCL has no setting for the processor's name. In memory, PoCL's record of a device has a pointer to this name.
``use_library_target`` changes the pointer to the name of the library's processor."""

import contextlib
import ctypes
import logging
import mmap
import os
import platform
import re
import stat
import struct
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.parallel import Launch, launched

log = logging.getLogger(__name__)

_RECORD_BYTES = 2048  # this many bytes of PoCL's record of a device are searched for the processor's name
_LONGEST_TEXT = 64  # most bytes read of a text to which PoCL's record of a device points
_TRIPLE = re.compile(rb"x86_64-[a-z0-9_]+-linux-gnu\Z")
_PROCESSOR = re.compile(rb"[a-z0-9][a-z0-9.-]*\Z")
_USER_SPACE = 1 << 47  # every address of a process on x86-64 is below this
CACHE_VARIABLE = "POCL_CACHE_DIR"
AVX512_TARGET = "skylake-avx512"
_AVX = {"avx", "cx16", "popcnt"}
_LIBRARIES = (
    ({"avx512f", "avx512dq", "avx512bw", "avx512vl", "avx512cd"}, AVX512_TARGET),
    ({*_AVX, "avx2", "f16c", "fma", "bmi1", "bmi2", "abm", "movbe"}, "haswell"),
    ({*_AVX, "fma4", "xop"}, "bdver1"),
    ({*_AVX, "f16c"}, "ivybridge"),
    (_AVX, "sandybridge"),
    ({"sse4_1", "cx16"}, "penryn"),
    ({"ssse3", "cx16"}, "core2"),
)
"""PoCL's libraries of built-in functions: (flags, processor). PoCL takes the first library whose flags are all in
/proc/cpuinfo. ``processor`` is LLVM's name of the processor for which the library was compiled."""
_OLDEST_TARGET = "athlon64"  # the processor of the library that PoCL takes if no entry of ``_LIBRARIES`` fits
THREADS_VARIABLE = "POCL_MAX_PTHREAD_COUNT"
_ROOM_BYTES = 1 << 22  # a cache with less room is not used: LLVM ends the process if it cannot write a kernel
_MOST_THREADS = 1024  # largest POCL_MAX_PTHREAD_COUNT that is accepted
_NO_CACHE_VARIABLE = "PYOPENCL_NO_CACHE"
_unusable: tuple[Path, str] | None = None
_kept_alive: list[ctypes.Array[ctypes.c_char]] = []


def prepare_environment() -> None:
    """Sets PoCL's kernel cache on Linux: the folder POCL_CACHE_DIR, or one of this program. Call it before pyopencl loads.

    PoCL's default cache is named after LLVM's target, so two unknown processors would share binaries. If the cache cannot be
    written, PoCL finds no device. If it is full, or on a mount with noexec, PoCL ends the process. In all cases a temporary
    folder is used instead. pyopencl's own cache is switched off where it cannot be written. Where several ranks share a
    machine, each rank's threads are limited. Raises InputError for a number of threads that PoCL would crash on or ignore,
    and for a cache on a mount with noexec if no temporary folder works."""
    global _unusable
    if platform.system() != "Linux":
        return
    _share_cores(launched())
    _check_threads(os.environ.get(THREADS_VARIABLE))
    if _fault_of(_caches() / "pyopencl") == "written":
        os.environ.setdefault(_NO_CACHE_VARIABLE, "1")
    wish = os.environ.get(CACHE_VARIABLE)
    own = _caches() / "phyradgs-cl" / f"pocl-{library_target() or platform.machine()}"
    folder = Path(wish) if wish else own
    if (reason := _fault_of(folder)) is not None:
        _unusable = folder, reason
        try:
            folder = _temporary_cache()
        except OSError as error:
            if reason == "executed":  # PoCL would end the process
                found, remedy = f"{folder}, on a mount with noexec", f"set {CACHE_VARIABLE} to a folder on another mount"
                raise InputError(CACHE_VARIABLE, found, "a folder whose files may be executed", remedy) from error
            return  # the temporary folder does not work either: PoCL will have no device
    os.environ[CACHE_VARIABLE] = str(folder)


def _share_cores(launch: Launch) -> None:
    """Limits PoCL to this rank's share of the machine's cores, unless the launcher (as mpiexec) binds ranks to cores."""
    cores = os.cpu_count() or 1
    is_bound = len(os.sched_getaffinity(0)) < cores
    if launch.local_size > 1 and not is_bound:
        os.environ.setdefault(THREADS_VARIABLE, str(max(1, cores // launch.local_size)))


def _check_threads(wish: str | None) -> None:
    if wish and not (wish.isdecimal() and 1 <= int(wish[:9]) <= _MOST_THREADS):
        expected = f"a whole number from 1 to {_MOST_THREADS}"
        raise InputError(THREADS_VARIABLE, checks.short_repr(wish), expected, f"unset {THREADS_VARIABLE}")


def unusable_cache() -> Path | None:
    """Returns the folder that was to be PoCL's kernel cache but cannot be used. Returns None if the folder can be used, or
    once ``warn_of_cache`` has warned."""
    return _unusable and _unusable[0]


def warn_of_cache() -> None:
    """Warns once if the kernel cache had to be replaced by a temporary folder. Called when a PoCL device is listed, as
    other drivers do not use this cache."""
    global _unusable
    if _unusable is not None:
        text = "PoCL's kernel cache %s cannot be %s: kernels are kept in %s; set %s to a folder that can"
        log.warning(text, *_unusable, os.environ.get(CACHE_VARIABLE), CACHE_VARIABLE)
        _unusable = None


def _caches() -> Path:
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # the user has no home folder
        return Path("/nonexistent")


def _fault_of(folder: Path) -> str | None:
    """Returns what cannot be done with files in a folder, "written" or "executed"; None if both work. Creates the folder if
    there is none.

    On a mount with noexec the operating system refuses to map a page of a file as executable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, _ROOM_BYTES)
            try:
                mmap.mmap(file.fileno(), mmap.PAGESIZE, mmap.MAP_PRIVATE, mmap.PROT_READ | mmap.PROT_EXEC).close()
            except OSError:
                return "executed"
            return None
    except OSError:
        return "written"


def _temporary_cache() -> Path:
    """Returns a temporary folder that only this user can write, because binaries in it are executed. Raises OSError if no
    folder can be made."""
    places = [Path(place) for place in (tempfile.gettempdir(), "/var/tmp", "/dev/shm")]
    place = next((place for place in places if _fault_of(place) is None), None)
    if place is None:
        raise OSError("no temporary folder for kernels")
    folder = place / f"phyradgs-cl-{os.getuid()}"
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077:
            return folder
    return Path(tempfile.mkdtemp(prefix="phyradgs-cl-", dir=place))


def library_target() -> str | None:
    """Returns LLVM's name of the processor of PoCL's library for this machine, or None if the machine is not x86-64."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return None
    flags = _cpu_flags()
    return next((target for needed, target in _LIBRARIES if needed <= flags), _OLDEST_TARGET)


def use_library_target(device_address: int) -> str | None:
    """Makes PoCL 3.0 compile for the processor that its kernel library was built for, and returns this processor's name.

    Writes the name into PoCL's record of a CPU device. There, a pointer to LLVM's target triple is followed by a pointer to
    the processor's name. Changes nothing and returns None without such a pair, or not on x86-64 Linux. PoCL 3.1 and later
    name the processor themselves."""
    target = library_target()
    if target is None or platform.system() != "Linux":
        return None
    with _own_memory() as read:
        record = read(device_address, _RECORD_BYTES)
        words = struct.unpack(f"<{len(record) // 8}Q", record[: len(record) // 8 * 8])
        texts = [_text(read(word, _LONGEST_TEXT)) if 4096 < word < _USER_SPACE else None for word in words]
    for place, (triple, name) in enumerate(zip(texts, texts[1:], strict=False), start=1):
        if triple and name and _TRIPLE.match(triple) and _PROCESSOR.match(name):
            if name != target.encode():
                text = ctypes.create_string_buffer(target.encode())
                _kept_alive.append(text)
                ctypes.c_uint64.from_address(device_address + 8 * place).value = ctypes.addressof(text)
                log.info("PoCL builds kernels for %s, as its library, in place of %s", target, name.decode())
            return target
    return None


def _text(memory: bytes) -> bytes | None:
    text, end, _ = memory.partition(b"\0")
    return text if end else None


@contextlib.contextmanager
def _own_memory() -> Iterator[Callable[[int, int], bytes]]:
    """Yields a function that reads this process's memory. An unmapped address gives b'' instead of a crash."""
    handle = os.open("/proc/self/mem", os.O_RDONLY)

    def read(address: int, count: int) -> bytes:
        try:
            return os.pread(handle, count, address)
        except (OSError, OverflowError):
            return b""

    try:
        yield read
    finally:
        os.close(handle)


def _cpu_flags() -> set[str]:
    return set(cpu_facts().get("flags", "").split())


def cpu_facts(described: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """Returns the entries of ``described`` for the first processor ("model name", "flags", …); {} if it is not readable."""
    facts: dict[str, str] = {}
    with contextlib.suppress(OSError):
        for line in described.read_text().split("\n\n", 1)[0].splitlines():
            name, _, value = line.partition(":")
            facts[name.strip()] = value.strip()
    return facts


def cpu_name(facts: dict[str, str] | None = None) -> str:
    """Returns the processor's name, with family and model if known, because several generations may share a name."""
    facts = cpu_facts() if facts is None else facts
    name = facts.get("model name") or platform.processor() or platform.machine()
    if "cpu family" in facts and "model" in facts:
        return f"{name}, family {facts['cpu family']} model {facts['model']}"
    return name
