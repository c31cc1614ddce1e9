"""Builds kernels for any x86 processor that this one can stand for, and reads the machine code of PoCL's objects."""

import os
import re
import struct
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from capstone import CS_ARCH_X86, CS_MODE_64, Cs

from phyradgs_cl.runtime import pocl

BUILD = """
import sys
from phyradgs_cl.runtime import context, pocl
target, lanes, chosen = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
pocl.library_target = lambda: target
context.default_lanes = lambda device: lanes
from phyradgs_cl import device_check
from phyradgs_cl.runtime import list_devices
assert list_devices()[0].target == target, list_devices()
device_check.CHECKS = tuple(c for c in device_check.CHECKS if not chosen or c.__name__ in chosen)
differences = device_check._differences
device_check._differences = lambda function, rows, h=None: differences(function, rows) if h is None else rows
device_check._by_class = lambda found, rows: ()  # what tests/test_device_check.py compares takes longer than the builds
verdict = device_check.check_device("0")
assert not verdict.failures, verdict
"""
# target, the ending of its library's name, vector width, a flag that the processor needs
TARGETS = [("skylake-avx512", "avx512", 16, "avx512vl"), ("haswell", "avx2", 8, "avx2"), ("sandybridge", "avx", 8, "avx")]
WHEEL = find_spec("pocl_binary_distribution")
HERE = [row[:3] for row in TARGETS if WHEEL is not None and row[3] in pocl._cpu_flags()]
"""The targets that this processor can execute, the widest first."""


def built(
    target: str, library: str, lanes: int, tmp_path: Path, *checks: str, cache: Path | None = None
) -> list[tuple[str, Path]]:
    """Names and objects of the kernels that ``check_device`` runs, or some of its checks, built for a target.

    A copy of PoCL's files, in which every library is that of the target, stands for a machine with such a processor.
    cache: a folder of PoCL's that may hold them already."""
    vendors, cache = copy_of_pocl(Path(WHEEL.origin).parents[1], library, tmp_path), cache or tmp_path / "cache"
    environment = {**os.environ, "POCL_CACHE_DIR": str(cache), "OCL_ICD_VENDORS": str(vendors)}
    command, started_s = [sys.executable, "-c", BUILD, target, str(lanes), *checks], time.time() - 1
    subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    used = [path.parent for path in cache.glob("*/*/last_accessed") if path.stat().st_mtime >= started_s]
    return [(path.parent.parent.name, path) for program in used for path in program.rglob("*.so")]


def copy_of_pocl(site: Path, library: str, tmp_path: Path) -> Path:
    """The folder of a vendor file that names PoCL in a tree of links where each library of built-ins is ``library``."""
    (own,) = (site / "pyopencl" / ".libs").glob("libpocl-*.so")
    binary, share = tmp_path / "pyopencl" / ".libs", tmp_path / "pocl_binary_distribution" / ".libs" / "share" / "pocl"
    for folder in (binary, share, tmp_path / "vendors"):
        folder.mkdir(parents=True)
    (binary / own.name).symlink_to(own)
    shipped = site / "pocl_binary_distribution" / ".libs"
    for path in shipped.glob("libhwloc*"):
        (share.parents[1] / path.name).symlink_to(path)
    (share / "include").symlink_to(shipped / "share" / "pocl" / "include")
    libraries = list((shipped / "share" / "pocl").glob("kernel-*.bc"))
    (wanted,) = (path for path in libraries if path.stem.endswith(f"-{library}"))
    for path in libraries:
        (share / path.name).symlink_to(wanted)
    (tmp_path / "vendors" / "pocl.icd").write_text(f"{binary / own.name}\n")
    return tmp_path / "vendors"


ARITHMETIC = re.compile(r"v?(?:add|sub|mul|div|sqrt|min|max|fn?m(?:add|sub)\d+)([ps])([sd])")
OF_MASKS = ("kand", "kor", "knot", "kxor", "kxnor")
WIDTHS = {"xmm": 16, "ymm": 32, "zmm": 64}  # bytes


@dataclass
class Code:
    """packed, arithmetic: floating-point operations, the packed ones weighted by nothing; widest: bytes of a register that
    they use; masked_as_one: accesses to memory under a mask that was a single number, so all lanes or none."""

    packed: int = 0
    arithmetic: int = 0
    widest: int = 0
    masked_as_one: int = 0


def code_of(path: Path) -> Code:
    """Disassembles an object. Which masks hold a single number is followed from one instruction to the next."""
    code, single = Code(), set[str]()
    masks_memory = False
    spread = 0  # of a single condition over a register, in processors without registers for masks
    for _, _, name, operands in Cs(CS_ARCH_X86, CS_MODE_64).disasm_lite(text_of(path), 0):
        if match := ARITHMETIC.fullmatch(name):
            code.arithmetic += 1
            if match[1] == "p":
                code.packed += 1
                code.widest = max(code.widest, *(WIDTHS[one] for one in re.findall("[xyz]mm", operands)))
        masks_memory |= name.startswith("vmaskmov")
        spread += name in ("vpbroadcastb", "vpshuflw")
        target, *sources = re.findall(r"\bk[0-7]\b", operands) or [""]
        if name.startswith("kmov") and not sources and re.match("k[0-7], [er]", operands):
            single.add(target)
        elif name.startswith(OF_MASKS) or name.startswith("vpcmp"):
            (single.add if single & set(sources) else single.discard)(target)
        elif target in single and re.search(r"\[.*\]", operands) and name.startswith("vmov"):
            code.masked_as_one += 1
    if masks_memory:
        code.masked_as_one += spread
    return code


def text_of(path: Path) -> bytes:
    """Returns the section .text of an ELF file of 64 bits."""
    data = path.read_bytes()
    (table,), (each, count, names) = struct.unpack_from("<Q", data, 40), struct.unpack_from("<3H", data, 58)
    headers = [struct.unpack_from("<2I4Q", data, table + k * each) for k in range(count)]
    of_names = headers[names][4]
    for name, _, _, _, offset, size in headers:
        if data[of_names + name :].startswith(b".text\0"):
            return data[offset : offset + size]
    raise AssertionError(f"{path} has no code")
