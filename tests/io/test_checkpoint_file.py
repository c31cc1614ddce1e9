"""Checkpoint archives: read as they were written, or refused with what to do."""

import io
import os
import pickle
import zipfile
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.io import read_checkpoint, write_checkpoint

ARRAYS = {"volume": np.arange(24.0, dtype=np.float32).reshape(2, 3, 4), "note": np.array("text")}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_checkpoint(tmp_path / "c.npz", ARRAYS)
    return tmp_path / "c.npz"


def rewrite(path: Path, changes: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in (content | changes).items():
            archive.writestr(name, data)


def npy(array: np.ndarray) -> bytes:
    np.save(stream := io.BytesIO(), array)
    return stream.getvalue()


def refused(path: Path, words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        read_checkpoint(path)
    assert "without --resume" in str(error.value)


def test_what_was_written_is_read(path) -> None:
    """Columns that come first keep their order."""
    for _ in range(2):
        found = read_checkpoint(path)
        assert sorted(found) == sorted(ARRAYS)
        for name, values in ARRAYS.items():
            np.testing.assert_array_equal(found[name], values)
        rewrite(path, {"volume.npy": npy(np.asfortranarray(ARRAYS["volume"]))})


def test_none_another_versions_or_one_that_cannot_be_opened(path, monkeypatch) -> None:
    refused(path.with_name("none.npz"), "no checkpoint")
    rewrite(path, {"format.npy": npy(np.array(1))})
    refused(path, "a checkpoint of another version")
    monkeypatch.setattr(zipfile, "ZipFile", Mock(side_effect=PermissionError(13, "Permission denied")))
    refused(path, r"a damaged checkpoint \(Permission denied\)")


class Bomb:
    """Runs a shell command when it is unpickled by anything that runs what a pickle says."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch canary",)


def test_archives_that_no_run_writes(path, monkeypatch) -> None:
    """What executes, what declares terabytes, what is cut off: nothing of it is run."""
    monkeypatch.chdir(path.parent)
    good, volume = path.read_bytes(), npy(ARRAYS["volume"])
    for name, content in [
        *(("volume.npy", volume.replace(b"(2, 3, 4)", text)) for text in (b"(9, 9, 9)", b"(999999, 999999)", b"(-3, 8, 8)")),
        ("volume.npy", volume.replace(b"(2, 3, 4)", b"__import__('os').system('touch canary')")),
        ("volume.npy", volume.replace(b"(2, 3, 4)", b"(" * 500)), ("volume.npy", volume[:-8]),
        ("volume.npy", b"no array"), ("volume.txt", b"hello"), ("volume.npy", npy(np.array([None]))),
        ("more.npy", npy(np.array([Bomb()], object))),
    ]:  # fmt: skip
        path.write_bytes(good)
        rewrite(path, {name: content})
        refused(path, "a damaged checkpoint")
    for content in (b"", b"no archive", pickle.dumps(Bomb()), b"PK\x05\x06" + b"\0" * 18, good[: len(good) // 2]):
        path.write_bytes(content)
        refused(path, "checkpoint")
    assert list(path.parent.iterdir()) == [path]


def test_a_changed_byte_is_noticed(path) -> None:
    """In the header of the archive's member, in that of the array, in its numbers: by the checksum if by nothing else."""
    good = path.read_bytes()
    for at in (0, 33, 66, 127, 300):
        content = bytearray(good)
        content[at] ^= 0x11
        path.write_bytes(content)
        refused(path, "a damaged checkpoint")
