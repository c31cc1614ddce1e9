"""Keeps PoCL's wheel usable on processors that are newer than the LLVM inside it.

PoCL 3.0 asks LLVM 14 for the host's name. For a processor that LLVM does not know the answer is
"generic", which LLVM's own front end then refuses ("unknown target CPU 'generic'"), so that no kernel
builds (pocl/pocl issue 1049). Others it takes for their elder: AMD's Zen 4 is "znver3" to it, which has no
AVX-512, while PoCL looks at the instruction sets and links its library for AVX-512: LLVM then aborts the
whole process ("Cannot select: i64 = fma"). PoCL has no setting for either. What it does have is a device
record that holds a pointer to that name; here the pointer is turned to the name of an older processor with
the same instruction sets. The record is only read until exactly one of the wrong names has been found in it.
"""

import contextlib
import ctypes
import logging
import os
import platform
import stat
import struct
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.parallel import Launch, launched
from phyradgs_cl.runtime.host_cpu import cpu_facts

log = logging.getLogger(__name__)

_RECORD_BYTES = 2048
_UNKNOWN = frozenset({b"generic"})
# LLVM 14's names for processors of which there are some with AVX-512, though the name says that there is none
_WITHOUT_AVX512 = frozenset({b"znver3", b"alderlake"})
_LONGEST_NAME = max(map(len, _UNKNOWN | _WITHOUT_AVX512))
_USER_SPACE = 1 << 47
CACHE_VARIABLE = "POCL_CACHE_DIR"
AVX512_TARGET = "skylake-avx512"
THREADS_VARIABLE = "POCL_MAX_PTHREAD_COUNT"
_MOST_THREADS = 1024
_NO_CACHE_VARIABLE = "PYOPENCL_NO_CACHE"
_unwritable: Path | None = None
_kept_alive: list[ctypes.Array[ctypes.c_char]] = []


def prepare_environment() -> None:
    """Gives PoCL a kernel cache of its own for this processor, unless the user has chosen one. Before pyopencl loads.

    PoCL names its cache after the LLVM target, so two unknown processors would share binaries. Without a cache that
    can be written it has no device at all: then there is one in the temporary folder. pyopencl's own goes then.

    Raises:
        InputError: a number of threads that PoCL would crash on, or take for none without a word.
    """
    global _unwritable
    if platform.system() != "Linux":
        return
    _share_cores(launched())
    _check_threads(os.environ.get(THREADS_VARIABLE))
    if not _can_write(_caches() / "pyopencl"):
        os.environ.setdefault(_NO_CACHE_VARIABLE, "1")
    wish = os.environ.get(CACHE_VARIABLE)
    folder = Path(wish) if wish else _own_cache()
    if not _can_write(folder):
        _unwritable = folder
        try:
            folder = _temporary_cache()
        except OSError:  # not there either: PoCL will have no device
            return
    os.environ[CACHE_VARIABLE] = str(folder)


def _share_cores(launch: Launch) -> None:
    """Gives each of several processes on a machine its part of the cores, unless their launcher has bound them."""
    cores = os.cpu_count() or 1
    is_bound = len(os.sched_getaffinity(0)) < cores
    if launch.local_size > 1 and not is_bound:
        os.environ.setdefault(THREADS_VARIABLE, str(max(1, cores // launch.local_size)))


def _check_threads(wish: str | None) -> None:
    if wish and not (wish.isdecimal() and 1 <= int(wish[:9]) <= _MOST_THREADS):
        expected = f"a whole number from 1 to {_MOST_THREADS}"
        raise InputError(THREADS_VARIABLE, checks.shown(wish), expected, f"unset {THREADS_VARIABLE}")


def unwritable_cache() -> Path | None:
    """The cache that cannot be written, where that has not been said yet."""
    return _unwritable


def tell_of_cache() -> None:
    """Says, once, that kernels are kept elsewhere than they should be; for those who do use PoCL."""
    global _unwritable
    if _unwritable is not None:
        log.warning(
            "PoCL's kernel cache %s cannot be written: kernels are kept in %s; set %s to a folder that can",
            _unwritable,
            os.environ.get(CACHE_VARIABLE),
            CACHE_VARIABLE,
        )
        _unwritable = None


def _own_cache() -> Path:
    return _caches() / "phyradgs-cl" / f"pocl-{equivalent_target() or platform.machine()}"


def _caches() -> Path:
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # a user without a home
        return Path("/nonexistent")


def _can_write(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _temporary_cache() -> Path:
    """A folder that is this user's alone: what lies in it is run."""
    folder = Path(tempfile.gettempdir()) / f"phyradgs-cl-{os.getuid()}"
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
            return folder
    return Path(tempfile.mkdtemp(prefix="phyradgs-cl-"))


def equivalent_target() -> str | None:
    """An LLVM 14 processor name with this machine's vector instructions, or None where there is none."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return None
    flags = _cpu_flags()
    if {"avx512f", "avx512dq", "avx512bw", "avx512vl", "avx512cd"} <= flags:
        return AVX512_TARGET
    if {"avx2", "fma", "bmi1", "bmi2"} <= flags:
        return "haswell"
    if "avx" in flags:
        return "sandybridge"
    return "x86-64"


def repair_unknown_target(device_address: int) -> str | None:
    """Names the equivalent processor in the record of a PoCL CPU device, if LLVM does not know the real one.

    Returns the name that was set, or None when nothing had to be done (or nothing could be).
    """
    target = equivalent_target()
    if target is None or platform.system() != "Linux":
        return None
    wrong = _UNKNOWN | _WITHOUT_AVX512 if target == AVX512_TARGET else _UNKNOWN
    with _own_memory() as read:
        record = read(device_address, _RECORD_BYTES)
        for offset in range(0, len(record) - 7, 8):
            (pointer,) = struct.unpack_from("<Q", record, offset)
            if 4096 < pointer < _USER_SPACE and _text(read(pointer, _LONGEST_NAME + 1)) in wrong:
                name = ctypes.create_string_buffer(target.encode())
                _kept_alive.append(name)
                ctypes.c_uint64.from_address(device_address + offset).value = ctypes.addressof(name)
                log.info("PoCL does not know this processor; its kernels are built for %s", target)
                return target
    return None


def _text(memory: bytes) -> bytes | None:
    """The C string that a piece of memory begins with; None where it does not end in it."""
    text, end, _ = memory.partition(b"\0")
    return text if end else None


@contextlib.contextmanager
def _own_memory() -> Iterator[Callable[[int, int], bytes]]:
    """A reader of this process's memory that answers b'' for an unmapped address instead of crashing."""
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
