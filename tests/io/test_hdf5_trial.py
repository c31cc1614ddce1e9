"""Files that the HDF5 library does not survive: another process finds out, and is replaced."""

import sys
import threading
import time
import zlib
from pathlib import Path

import h5py
import pytest
from corpus.worker import peak_megabytes, reset_peak

from phyradgs_cl.errors import InputError, OutOfMemoryError
from phyradgs_cl.io.hdf5 import trial as hdf5_trial
from phyradgs_cl.io.hdf5.datasets import read_values
from phyradgs_cl.io.hdf5.source import open_hdf5

KEPT = Path(__file__).resolve().parents[1] / "corpus" / "kept"
CRASHES = KEPT / "import_of_nxtomo" / "crashes_hdf5.h5"
NEVER_ENDS = KEPT / "scan" / "never_ends_in_hdf5.h5"


@pytest.fixture(autouse=True, params=["a copy", "an interpreter"])
def way(request, monkeypatch) -> str:
    """Both kinds of process; nothing is known of a file."""
    if request.param == "a copy" and not hdf5_trial.FORKS:
        pytest.skip("copies of processes are Linux's")  # pragma: no cover
    monkeypatch.setattr(hdf5_trial, "FORKS", request.param == "a copy")
    hdf5_trial._verdict.cache_clear()
    return request.param


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
    assert error.value.subject == str(path)
    return error.value.found


def test_a_file_that_keeps_hdf5_for_ever_is_refused_and_the_next_is_read(good, monkeypatch) -> None:
    monkeypatch.setattr(hdf5_trial, "CPU_SECONDS", 0)  # of a second that has begun, at most
    assert "does not finish reading" in refusal_of(NEVER_ENDS)
    assert value_of(good) == 3.0


def test_a_file_that_crashes_hdf5_is_refused_and_the_next_is_read(good, capfd) -> None:
    assert "the HDF5 library crashes on it" in refusal_of(CRASHES)
    assert value_of(good) == 3.0
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(sys.platform != "linux", reason="memory as Linux counts it")
def test_a_file_whose_headers_ask_for_much_memory_is_refused_and_the_next_is_read(good, monkeypatch) -> None:
    monkeypatch.setattr(hdf5_trial, "CPU_SECONDS", 60)  # a gigabyte takes long where memory is short
    held = bytearray(400 << 20)  # what this process holds is not the other's
    held[:: 1 << 12] = b"1" * (len(held) >> 12)
    assert "ask HDF5 for more than 256 MiB" in refusal_of(KEPT / "import_of_nxtomo" / "asks_for_memory.h5")
    assert value_of(good) == 3.0


def test_a_look_that_waits_for_ever_is_given_up(good, tmp_path, monkeypatch) -> None:
    """On a disk that does not answer no processor is used: the clock counts."""
    waits = tmp_path / "waits.py"
    waits.write_text("import time; time.sleep(600)")
    monkeypatch.setattr(hdf5_trial, "_LOOK", waits)
    monkeypatch.setattr("phyradgs_cl.io.hdf5.look.__main__._Walk.through", lambda *_: time.sleep(600))
    monkeypatch.setattr(hdf5_trial, "SECONDS", 0.3)
    assert "does not finish reading" in refusal_of(good)


def test_where_no_process_can_be_had_files_are_read_without(good, tmp_path, monkeypatch, way) -> None:
    def none() -> int:
        raise BlockingIOError("too many processes")

    monkeypatch.setattr(hdf5_trial.os, "fork", none)
    monkeypatch.setattr(hdf5_trial.sys, "executable", "/no/such/python")
    assert value_of(good) == 3.0
    monkeypatch.setattr(hdf5_trial.sys, "executable", sys.executable)
    monkeypatch.setattr(hdf5_trial, "_LOOK", tmp_path / "none.py")
    hdf5_trial._verdict.cache_clear()
    assert value_of(good) == 3.0


def test_another_thread_in_hdf5_holds_nothing_up(good, way) -> None:
    """A copy of a process has one thread: what another one holds, it would wait for."""
    if way == "an interpreter":
        return
    stop = threading.Event()

    def read() -> None:
        with h5py.File(good) as file:
            while not stop.is_set():
                file["value"][()]

    threads = [threading.Thread(target=read) for _ in range(2)]
    for thread in threads:
        thread.start()
    try:
        for _ in range(20):
            hdf5_trial._verdict.cache_clear()
            assert value_of(good) == 3.0
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def test_modules_in_the_folder_at_hand_are_not_run(good, tmp_path, monkeypatch) -> None:
    """A scan may lie in a stranger's folder."""
    for name in ("h5py", "json", "resource", "numpy"):
        (tmp_path / f"{name}.py").write_text("open('canary', 'w')")
    monkeypatch.chdir(tmp_path)
    assert value_of(good) == 3.0
    assert not (tmp_path / "canary").exists()


def test_links_to_elsewhere_and_to_the_file_itself_are_not_followed(good) -> None:
    with h5py.File(good, "a") as file:
        file["outside"] = h5py.ExternalLink(str(CRASHES), "/")
        file["soft"] = h5py.SoftLink("/outside")
        file["group/again"] = file["/"]  # a circle: as many objects as are looked at
    assert value_of(good) == 3.0
    assert value_of(good) == 3.0
    before = hdf5_trial._verdict.cache_info().misses
    assert value_of(good) == 3.0 and hdf5_trial._verdict.cache_info().misses == before


@pytest.mark.skipif(sys.platform != "linux", reason="memory as Linux counts it")
@pytest.mark.parametrize("side", [100, 1000], ids=["that the look reads", "that only the reading reads"])
def test_a_chunk_that_inflates_to_a_gigabyte_takes_no_memory(tmp_path, side, way) -> None:
    """In a header that promises 40 kB, or 4 MB."""
    if way == "an interpreter":
        return
    path, packing = tmp_path / "bomb.h5", zlib.compressobj(9)
    head = packing.compress(b"") + packing.flush(zlib.Z_FULL_FLUSH)
    packed = head + 128 * (packing.compress(bytes(1 << 23)) + packing.flush(zlib.Z_FULL_FLUSH))
    with h5py.File(path, "w") as file:
        data = file.create_dataset("value", (side, side), "f4", chunks=(side, side), compression="gzip")
        data.id.write_direct_chunk((0, 0), packed)
    reset_peak()
    before = peak_megabytes()
    with pytest.raises(InputError, match="256 MiB|more than their header promises"), open_hdf5(path) as source:
        read_values(source, "/value", source.dataset("/value"))
    assert peak_megabytes() - before < 600


def test_what_is_larger_than_the_file_or_memory_is_refused(tmp_path, good, monkeypatch) -> None:
    """A value is asked for, and 2 GiB would be made for it."""
    path = tmp_path / "chunk.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("value", (1,), "f4", maxshape=(None,), chunks=(1 << 29,))
    with pytest.raises(InputError, match="chunks of"), open_hdf5(path) as source:
        source.dataset("/value")
    monkeypatch.setattr("phyradgs_cl.io.hdf5.datasets.host_bytes", lambda: 8.0)
    with pytest.raises(OutOfMemoryError, match="memory can hold"), open_hdf5(good) as source:
        read_values(source, "/value", source.dataset("/value"))
