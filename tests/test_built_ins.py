"""Built-in functions are inlined: no object that PoCL has built calls one. `make stress`: every target."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from phyradgs_cl.runtime import pocl

BUILD_EVERY_KERNEL = """
import sys
from phyradgs_cl.runtime import context, pocl
target, lanes = sys.argv[1], int(sys.argv[2])
pocl.library_target = lambda: target
context.default_lanes = lambda device: lanes
from phyradgs_cl.device_check import check_device
from phyradgs_cl.runtime import list_devices
assert list_devices()[0].target == target, list_devices()
verdict = check_device("0")
assert not verdict.failures, verdict
"""
LONG_FUNCTIONS = {"log1p", "expm1"}  # of many instructions: a call costs little in comparison
# target, the ending of its library's name, vector width, a flag that the processor needs
TARGETS = [("skylake-avx512", "avx512", 16, "avx512vl"), ("haswell", "avx2", 8, "avx2"), ("sandybridge", "avx", 8, "avx")]
WHEEL = find_spec("pocl_binary_distribution")
HERE = [row[:3] for row in TARGETS if WHEEL is not None and row[3] in pocl._cpu_flags()]  # the widest first
MOST = len(TARGETS) if int(os.environ.get("STRESS", "1")) > 1 else 1


@pytest.mark.parametrize("target, library, lanes", HERE[:MOST])
def test_no_kernel_calls_a_built_in_function(target, library, lanes, tmp_path) -> None:
    """Looks into the objects that PoCL has built.

    A copy of PoCL's files, in which every library is that of the target, stands for a machine with such a processor.
    """
    vendors = copy_of_pocl(Path(WHEEL.origin).parents[1], library, tmp_path)
    environment = {**os.environ, "POCL_CACHE_DIR": str(tmp_path / "cache"), "OCL_ICD_VENDORS": str(vendors)}
    command = [sys.executable, "-c", BUILD_EVERY_KERNEL, target, str(lanes)]
    subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    objects = list((tmp_path / "cache").rglob("*.so"))
    assert len(objects) > 50
    calls = {
        (path.parent.parent.name, name.decode())
        for path in objects
        for name in re.findall(rb"_Z[0-9]+_cl_([a-z0-9_]+?)(?:Dv|[A-Z]|[a-z]\0|\0)", path.read_bytes())
    }
    assert {call for call in calls if call[1] not in LONG_FUNCTIONS} == set()


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
