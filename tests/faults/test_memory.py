"""A machine whose memory runs out: one line, status 6, nothing half written."""

import subprocess
import sys

import faults_kit as kit
import h5py
import pytest

pytestmark = pytest.mark.slow
# In a process of its own that may map no more than so many MiB beyond what it has at the start.
LIMITED = """
import resource, sys
from pathlib import Path
from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.runtime import Runtime
cli = load_cli()
Runtime()
pages = int(Path("/proc/self/statm").read_text().split()[0])
limit = pages * resource.getpagesize() + (int(sys.argv[1]) << 20)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
sys.exit(cli.run(sys.argv[2:]))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="address space limits of POSIX")
@pytest.mark.parametrize("source", ["phantom", "scan"])
def test_a_machine_without_memory_is_said(scan, tmp_path, source) -> None:
    output = tmp_path / "v.h5"
    output.write_bytes(kit.OLD)
    words = ["simulate", "--phantom", "jaw", "--size", "512", "--detector", "16", "--views", "2"]
    if source == "scan":  # with half a gigabyte of voxels to reconstruct
        large = tmp_path / "large.h5"
        large.write_bytes(scan.read_bytes())
        with h5py.File(large, "r+") as file:
            file["entry/phyradgs/grid/shape"][...] = 512
            del file["entry/phyradgs/reference"]
        words = ["reconstruct", str(large), "--method", "sirt"]
    command = [sys.executable, "-c", LIMITED, "256", *words, "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    lines = [line for line in done.stderr.splitlines() if line.startswith("phyradgs:")]
    assert (done.returncode, len(lines)) == (6, 1), done.stderr
    assert lines[0].startswith("phyradgs: memory of ") and "Traceback" not in done.stderr
    assert output.read_bytes() == kit.OLD and set(kit.names(tmp_path)) <= {"large.h5", "v.h5"}
