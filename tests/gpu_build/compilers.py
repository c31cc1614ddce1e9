"""Compiles OpenCL C for GPUs of three makers on a machine that has none, and reads what each kernel costs there.

Needs clang-15 with libclc-15 (NVIDIA, AMD), ptxas (NVIDIA) and ocloc (Intel); ``make test-gpu-build`` unpacks them into
the folder that GPU_COMPILERS names and does not change the system.
"""

import os
import re
import shutil
import subprocess
import sysconfig
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(os.environ.get("GPU_COMPILERS", "/"))
LIBCLC, BINARIES, LIBRARIES = ROOT / "usr/lib/clc", ROOT / "usr/bin", ROOT / "usr/lib/x86_64-linux-gnu"
SM_REGISTERS, SM_WARPS, REGISTER_STEP = 65536, 64, 8  # Hopper: registers per multiprocessor; per thread in steps of 8


@dataclass(frozen=True)
class KernelCost:
    """``registers`` per work-item, ``local_bytes`` per work-group, ``warps`` that fit a multiprocessor by registers; None
    where a compiler does not say. ``spilled_bytes``: memory per work-item for what found no register.
    """

    target: str
    kernel: str
    registers: int | None
    spilled_bytes: int
    local_bytes: int | None
    warps: int | None


class Refused(Exception):
    """The message of a compiler that did not build."""


def nvidia(source: Path, options: Sequence[str], folder: Path) -> list[KernelCost]:
    """PTX by LLVM, machine code for Hopper by ptxas."""
    ptx = folder / "kernel.ptx"
    _clang(source, options, "nvptx64--nvidiacl", "sm_80", "nvptx64--nvidiacl.bc", ptx)
    found, said = [], _output(str(_ptxas()), "-v", "-arch=sm_90", "-o", os.devnull, str(ptx))
    for block in said.split("Compiling entry function ")[1:]:
        name, registers = _match(r"'(\w+)'", block), int(_match(r"Used (\d+) registers", block))
        # the frame holds spilled registers, and arrays whose index is not known when the kernel is built
        spilled = int(_match(r"(\d+) bytes stack frame", block))
        local = sum(int(count) for count in re.findall(r"(\d+) bytes smem", block))
        warps = min(SM_WARPS, SM_REGISTERS // (-(-registers // REGISTER_STEP) * REGISTER_STEP * 32))
        found.append(KernelCost("NVIDIA sm_90", name, registers, spilled, local, warps))
    return found


def amd(source: Path, options: Sequence[str], folder: Path) -> list[KernelCost]:
    """RDNA 2, whose figures LLVM writes into the assembly; its waves are those of half a work-group processor."""
    found, assembly = [], folder / "kernel.s"
    _clang(source, options, "amdgcn-amd-amdhsa", "gfx1030", "amdgcn--amdhsa.bc", assembly)
    text = assembly.read_text(encoding="utf-8")
    for name, block in re.findall(r"\.amdhsa_kernel (\w+)\n(.*?)(?=\.amdhsa_kernel |\Z)", text, re.S):
        registers, scratch, local, waves = (
            int(_match(rf"; {key}: (\d+)", block)) for key in ("NumVgprs", "ScratchSize", "LDSByteSize", "Occupancy")
        )
        found.append(KernelCost("AMD gfx1030", name, registers, scratch, local, waves))
    return found


def intel(source: Path, options: Sequence[str], folder: Path) -> list[KernelCost]:
    """Arc (dg2), which has no float64; ocloc says whether it builds, and warns of kernels that spill."""
    said = _output(
        str(BINARIES / "ocloc"), "compile", "-file", str(source), "-device", "dg2",
        "-options", " ".join(options), "-out_dir", str(folder),
    )  # fmt: skip
    if "Build succeeded" not in said:
        raise Refused(said)
    kernels = re.findall(r"__kernel\s+void\s+(\w+)", source.read_text(encoding="utf-8"))
    spills = dict(re.findall(r"kernel (\w+)\s.*spilled around (\d+)", said))
    return [KernelCost("Intel dg2", name, None, int(spills.get(name, 0)), None, None) for name in kernels]


TARGETS: dict[str, tuple[Callable[[Path, Sequence[str], Path], list[KernelCost]], bool]] = {
    "nvidia": (nvidia, True), "amd": (amd, True), "intel": (intel, False),
}  # fmt: skip
"""By name: how to build, and whether such a device has float64."""


def missing() -> list[str]:
    """The tools that are not there."""
    needed = {
        "clang-15": (BINARIES / "clang-15").exists(), "libclc-15": LIBCLC.is_dir(),
        "ptxas": _ptxas(), "ocloc": (BINARIES / "ocloc").exists(),
    }  # fmt: skip
    return [name for name, found in needed.items() if not found]


def _ptxas() -> Path | str | None:
    package = Path(sysconfig.get_paths()["purelib"]) / "nvidia/cuda_nvcc/bin/ptxas"
    return package if package.exists() else shutil.which("ptxas")


def _clang(source: Path, options: Sequence[str], target: str, cpu: str, library: str, out: Path) -> None:
    behind = ["-target-cpu", cpu, "-mlink-bitcode-file", str(LIBCLC / library)]
    _output(
        str(BINARIES / "clang-15"), "-x", "cl", *options, "-target", target, "-O3", "-S", "-nogpulib",
        *(word for one in behind for word in ("-Xclang", one)), "-o", str(out), str(source),
    )  # fmt: skip


def _output(*command: str) -> str:
    paths = f"{LIBRARIES}:{LIBRARIES / 'intel-opencl'}"
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "LD_LIBRARY_PATH": paths})
    said = done.stdout + done.stderr
    if done.returncode:
        raise Refused(said)
    return said


def _match(pattern: str, text: str) -> str:
    found = re.search(pattern, text)
    if found is None:
        raise Refused(f"the compiler says nothing like {pattern}: {text[:300]}")
    return found[1]
