"""Files that the HDF5 library does not survive: another process finds out, and is replaced."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.io import hdf5_trial
from phyradgs_cl.io.hdf5 import open_hdf5

KEPT = Path(__file__).resolve().parents[1] / "corpus" / "kept"
CRASHES = KEPT / "import_of_nxtomo" / "crashes_hdf5.h5"
NEVER_ENDS = KEPT / "scan" / "never_ends_in_hdf5.h5"


@pytest.fixture
def scout(monkeypatch):
    """A process of the test's own, not yet started."""
    mine = hdf5_trial._Scout()
    monkeypatch.setattr(hdf5_trial, "_scout", mine)
    hdf5_trial._verdict.cache_clear()
    yield mine
    mine.leave()


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "good.h5"
    with h5py.File(path, "w") as file:
        file["value"] = 3.0
    return path


def value_of(path: Path) -> float:
    with open_hdf5(path) as source:
        return float(source.dataset("/value")[()])


def refusal_of(path: Path) -> str:
    with pytest.raises(InputError) as error, open_hdf5(path):
        pass
    assert error.value.culprit == str(path)
    return error.value.found


def test_a_file_that_keeps_hdf5_for_ever_is_refused_and_the_next_is_read(scout, good, monkeypatch) -> None:
    monkeypatch.setattr(hdf5_trial, "CPU_SECONDS", 0)  # of a second that has begun, at most
    assert "does not finish reading" in refusal_of(NEVER_ENDS)
    assert value_of(good) == 3.0


def test_a_file_that_crashes_hdf5_is_refused_and_the_next_is_read(scout, good) -> None:
    assert "the HDF5 library crashes on it" in refusal_of(CRASHES)
    assert value_of(good) == 3.0


@pytest.mark.skipif(sys.platform == "win32", reason="peak memory as POSIX counts it")
def test_a_file_whose_headers_ask_for_much_memory_is_refused_and_the_next_is_read(
    scout, good, monkeypatch
) -> None:
    monkeypatch.setattr(hdf5_trial, "CPU_SECONDS", 60)  # a gigabyte takes long where memory is short
    held = bytearray(400 << 20)  # what this process holds is not the other's
    held[:: 1 << 12] = b"1" * (len(held) >> 12)
    assert "ask HDF5 for more than 256 MiB" in refusal_of(KEPT / "import_of_nxtomo" / "asks_for_memory.h5")
    assert value_of(good) == 3.0


def test_one_process_looks_at_all_files_once(scout, good, tmp_path) -> None:
    other = tmp_path / "other.h5"
    other.write_bytes(good.read_bytes())
    assert value_of(good) == value_of(other) == 3.0
    process, before = scout._process, hdf5_trial._verdict.cache_info().misses
    assert value_of(good) == 3.0 and scout._process is process
    assert hdf5_trial._verdict.cache_info().misses == before
    scout.leave()
    assert process.returncode == 0


def test_a_look_that_waits_for_ever_is_given_up(scout, good, tmp_path, monkeypatch) -> None:
    """On a disk that does not answer no processor is used: the clock counts."""
    waits = tmp_path / "waits.py"
    waits.write_text("import time; print('ready', flush=True); time.sleep(600)")
    monkeypatch.setattr(hdf5_trial, "_LOOK", waits)
    monkeypatch.setattr(hdf5_trial, "SECONDS", 0.3)
    assert "does not finish reading" in refusal_of(good)


@pytest.mark.parametrize("lacks", ["a program", "an interpreter"])
def test_where_no_process_can_be_had_files_are_read_without(
    scout, good, tmp_path, monkeypatch, lacks
) -> None:
    if lacks == "a program":
        monkeypatch.setattr(hdf5_trial, "_LOOK", tmp_path / "none.py")
    else:
        monkeypatch.setattr(hdf5_trial.sys, "executable", "/no/such/python")
    assert value_of(good) == 3.0 and scout._process is None


def test_modules_in_the_folder_at_hand_are_not_run(scout, good, tmp_path, monkeypatch) -> None:
    """A scan may lie in a stranger's folder."""
    for name in ("h5py", "json", "resource", "numpy"):
        (tmp_path / f"{name}.py").write_text("open('canary', 'w')")
    monkeypatch.chdir(tmp_path)
    assert value_of(good) == 3.0 and scout._process is not None
    assert not (tmp_path / "canary").exists()


def test_links_to_elsewhere_and_to_the_file_itself_are_not_followed(scout, good, tmp_path) -> None:
    with h5py.File(good, "a") as file:
        file["outside"] = h5py.ExternalLink(str(CRASHES), "/")
        file["soft"] = h5py.SoftLink("/outside")
        file["group/again"] = file["/"]  # a circle: as many objects as are looked at
    assert value_of(good) == 3.0 and scout._process is not None
