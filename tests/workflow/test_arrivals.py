"""When a file is complete: it stood still long enough, or was renamed into place."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from phyradgs_cl.workflow.watch import Arrivals


@pytest.fixture
def now() -> list[float]:
    return [0.0]


@pytest.fixture
def arrivals(tmp_path: Path, now: list[float]) -> Arrivals:
    return Arrivals(tmp_path, 5.0, lambda: now[0])


def names(arrivals: Arrivals) -> list[str]:
    return [arrival.path.name for arrival in arrivals.look()]


def test_a_file_that_is_written_waits_until_it_stands_still(arrivals, now, tmp_path) -> None:
    path = tmp_path / "scan.h5"
    for second in range(0, 20, 4):  # it grows
        with open(path, "ab") as file:
            file.write(b"x")
        now[0] = second
        assert names(arrivals) == []
    now[0] = 20.9
    assert names(arrivals) == []
    now[0] = 21.0
    assert names(arrivals) == ["scan.h5"]
    time.sleep(0.02)  # the clock of files ticks some hundred times per second
    path.write_bytes(b"y" * 5)  # of the same size
    assert names(arrivals) == []


def test_a_file_renamed_into_place_is_complete_at_once(arrivals, tmp_path) -> None:
    part = tmp_path / ".scan.h5.part"
    part.write_bytes(b"whole")
    assert names(arrivals) == []
    time.sleep(0.02)
    part.rename(tmp_path / "scan.h5")
    assert names(arrivals) == ["scan.h5"]
    (tmp_path / "copy.h5").write_bytes(b"whole")
    os.utime(tmp_path / "copy.h5", ns=(10**18, 10**18))  # a copy that keeps its times
    assert names(arrivals) == ["copy.h5", "scan.h5"]


def test_only_regular_files_with_the_suffix_are_scans_and_the_oldest_comes_first(arrivals, tmp_path) -> None:
    for age, name in enumerate(("b.h5", "a.h5", "notes.txt", ".hidden.h5", "c.h5.part")):
        (tmp_path / name).write_bytes(b"x")
        os.utime(tmp_path / name, (1000 + age, 1000 + age))
    (tmp_path / "folder.h5").mkdir()
    os.mkfifo(tmp_path / "pipe.h5")
    (tmp_path / "nowhere.h5").symlink_to(tmp_path / "none")
    (tmp_path / "empty.h5").touch()
    os.utime(tmp_path / "empty.h5", (1, 1))
    assert names(arrivals) == ["b.h5", "a.h5"]


def test_an_arrival_knows_whether_it_is_still_the_file(arrivals, tmp_path) -> None:
    path = tmp_path / "scan.h5"
    path.write_bytes(b"whole")
    os.utime(path, (1, 1))
    (arrival,) = arrivals.look()
    assert arrival.is_unchanged()
    os.utime(path, (2, 2))
    assert not arrival.is_unchanged()
    path.unlink()
    assert not arrival.is_unchanged()
