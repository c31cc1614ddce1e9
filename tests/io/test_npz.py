"""NumPy archives: what NumPy writes is read back, in no more memory than was allowed; all else is one error."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.npz import read_npz

ARRAYS = {
    "counts": np.arange(24, dtype=np.int16).reshape(2, 3, 4),
    "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "flags": np.array([True, False]),
    "text": np.array("note"),
    "none": np.zeros((0, 3), np.float32),
}
UNFOLDED = sum(array.nbytes for array in ARRAYS.values()) + 128 * len(ARRAYS)  # a header is 128 bytes long


def refusal(path: Path, **bounds: int) -> InputError:
    with pytest.raises(InputError) as error:
        read_npz(path, "file of arrays", "make another", **bounds)
    assert (error.value.culprit, error.value.remedy) == (str(path), "make another")
    return error.value


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_come_back_within_exactly_their_bytes(tmp_path, save) -> None:
    path = tmp_path / "a.npz"
    save(path, **ARRAYS)
    found = read_npz(path, "file of arrays", "", most_bytes=UNFOLDED)
    assert sorted(found) == sorted(ARRAYS)
    for name, values in ARRAYS.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype and found[name].flags.writeable
        assert found[name].flags.f_contiguous == values.flags.f_contiguous
    assert refusal(path, most_bytes=UNFOLDED - 1).found == "a damaged file of arrays"


def test_without_a_bound_nothing_larger_than_the_file_is_unfolded(tmp_path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, zeros=np.zeros(1000))
    np.testing.assert_array_equal(read_npz(path, "file of arrays", "")["zeros"], np.zeros(1000))
    np.savez_compressed(path, zeros=np.zeros(1000))
    assert refusal(path).found == "a damaged file of arrays"


@pytest.mark.parametrize("count", [64, 65])
def test_an_archive_has_at_most_64_arrays(tmp_path, count) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, *[np.zeros(1)] * count)
    if count == 64:
        assert len(read_npz(path, "file of arrays", "")) == 64
    else:
        assert refusal(path).found == "a damaged file of arrays"


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_compressions_that_numpy_does_not_write_are_refused(tmp_path, compression) -> None:
    """Their decoders unfold whole blocks, whatever was asked for."""
    path = tmp_path / "a.npz"
    np.savez(path, values=np.arange(5))
    with zipfile.ZipFile(path) as archive:
        content = archive.read("values.npy")
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("values.npy", content)
    assert refusal(path, most_bytes=1 << 20).found == "a damaged file of arrays"


@pytest.mark.parametrize("at", [0, 33, 66, 127, 300])
def test_a_changed_byte_is_noticed(tmp_path, at) -> None:
    """In the header of the archive's member, in that of the array, in its numbers: by the checksum if by nothing else."""
    path = tmp_path / "a.npz"
    np.savez(path, values=np.arange(50.0))
    content = bytearray(path.read_bytes())
    content[at] ^= 0x11
    path.write_bytes(content)
    assert refusal(path).found == "a damaged file of arrays"


def test_pipes_folders_and_nothing_are_no_archives(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, tmp_path / "none"):
        error = refusal(path)
        assert (error.found, error.expected) == ("no regular file", "a file of arrays")
