"""Damaged and hostile HDF5 files: each has its own verdict, one line, and bounds of time and memory."""

import shutil
import time
from pathlib import Path

import pytest
from corpus.good import write_good
from corpus.hdf5_files import Case, cases

from phyradgs_cl.errors import InputError, OutOfMemoryError
from phyradgs_cl.importers import load_attenuation
from phyradgs_cl.io import read_volume
from phyradgs_cl.io.files import in_use_bytes
from phyradgs_cl.workflow import load_scan

SECONDS, MEGABYTES, LEAST = 10.0, 1000.0, 600
READERS = {"fly.h5": load_scan, "counts.h5": load_scan, "volume.h5": read_volume, "bare.h5": load_attenuation}
pytestmark = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="the peak of memory as Linux counts it")


def complaint(case: Case, good: Path, folder: Path) -> str:
    """Reads the file of a case; returns what is wrong with the answer, or nothing."""
    folder.mkdir()
    path = Path(shutil.copy(good / case.of, folder))
    case.damage(path)
    Path("/proc/self/clear_refs").write_text("5")  # the peak of memory counts from here
    held, began_s = in_use_bytes("VmHWM:"), time.process_time()
    try:
        READERS[case.of](path)
    except (InputError, OutOfMemoryError) as error:
        named = f"{path}:/{case.address}" if case.address else str(path)
        if not case.refused or "\n" in str(error) or not error.subject.startswith(named):
            return f"must be {'named' if case.refused else 'read'}: {error}"
    else:
        if case.refused:
            return "must be refused"
    megabytes = (in_use_bytes("VmHWM:") - held) / 2**20
    too_much = time.process_time() - began_s > SECONDS or megabytes > MEGABYTES
    return f"took too much: {megabytes} MB" if too_much else ""


def test_every_file_gets_its_verdict(tmp_path) -> None:
    good, wrong, count = write_good(tmp_path / "good"), [], 0
    for count, case in enumerate(cases(good, seed=0), start=1):
        folder = tmp_path / str(count)
        if said := complaint(case, good, folder):
            wrong.append(f"{case.name}: {said}")
        shutil.rmtree(folder)
    assert not wrong, "\n".join(wrong)
    assert count > LEAST
