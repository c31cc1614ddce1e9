"""Scans dropped in while the watch is killed and started again: every one becomes a volume, once.

STRESS=50, which `make stress` sets, is a hundred scans and ten kills.
"""

import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from phyradgs_cl.io import read_volume, sha256_of

SCANS, KILLS = (100, 10) if int(os.environ.get("STRESS", "1")) > 1 else (8, 2)
METHOD = ["--method", "sirt", "--iterations", "150"]


class Volumes(threading.Thread):
    """Looks at a folder all the time: which volumes have appeared, and whether any was ever replaced."""

    def __init__(self, folder: Path) -> None:
        super().__init__(daemon=True)
        self.folder, self.first, self.replaced = folder, dict[str, tuple[int, int]](), set[str]()
        self.stopped = threading.Event()

    def run(self) -> None:
        while not self.stopped.wait(0.01):
            self.look()

    def look(self) -> None:
        for path in self.folder.glob("*.h5"):
            found = path.stat()
            version = (found.st_ino, found.st_mtime_ns)
            if self.first.setdefault(path.name, version) != version:
                self.replaced.add(path.name)


def drop(tiny_scan: Path, folder: Path, number: int) -> None:
    """Writes a scan: renamed into place, or written slowly in two pieces."""
    part, target = folder / f".{number}.part", folder / f"scan{number:03d}.h5"
    shutil.copy(tiny_scan, part)
    with h5py.File(part, "r+") as file:
        file["entry/instrument/detector/data"][0, 0, 0] = 0.001 * number
    if number % 3:
        part.rename(target)
        return
    whole = part.read_bytes()
    part.unlink()
    with open(target, "wb") as file:
        file.write(whole[: len(whole) // 2])
        file.flush()
        time.sleep(0.05)
        file.write(whole[len(whole) // 2 :])


@pytest.fixture
def start(tmp_path: Path):
    """Starts a watch; all are ended with the test."""
    started: list[subprocess.Popen] = []

    def starting(*more: str) -> subprocess.Popen:
        folders = [str(tmp_path / "in"), "-o", str(tmp_path / "out")]
        command = [sys.executable, "-m", "phyradgs_cl", "watch", *folders]
        pace = ["--poll-s", "0.05", "--settle-s", "0.4", "--checkpoint-every", "0.01"]
        with open(tmp_path / "log.txt", "a") as log:
            started.append(subprocess.Popen([*command, *METHOD, *pace, *more], stdout=log, stderr=log))
        return started[-1]

    yield starting
    for process in started:
        process.kill()
        process.wait()


def test_each_scan_becomes_a_volume_once_whatever_is_killed(start, tmp_path, tiny_scan) -> None:
    folder, out, rng = tmp_path / "in", tmp_path / "out", np.random.default_rng(0)
    folder.mkdir()
    out.mkdir()
    volumes = Volumes(out)
    volumes.start()
    kills_after = np.sort(rng.choice(np.arange(1, SCANS), KILLS, replace=False))
    process = start()
    for number in range(SCANS):
        drop(tiny_scan, folder, number)
        if number in kills_after:
            deadline = time.monotonic() + 60
            seen = len(volumes.first)
            while len(volumes.first) == seen and time.monotonic() < deadline:  # in the middle of its work
                time.sleep(0.005)
            time.sleep(float(rng.uniform(0, 0.05)))
            assert process.poll() is None, (tmp_path / "log.txt").read_text()
            process.kill()
            process.wait()
            process = start()
    deadline = time.monotonic() + 600
    while len(volumes.first) < SCANS and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    process.wait()
    volumes.stopped.set()
    volumes.join()
    volumes.look()
    text = (tmp_path / "log.txt").read_text()
    assert len(volumes.first) == SCANS, text
    assert not volumes.replaced and not list(out.glob("*.error.txt")), text
    for scan in folder.iterdir():
        stored = read_volume(out / scan.name)
        assert stored.provenance["scan_sha256"] == sha256_of(scan)
        assert stored.provenance.get("interrupted_at") is None and stored.provenance["iterations"] == 150
    done = start("--once")
    assert done.wait(timeout=60) == 0
    volumes.look()
    assert not volumes.replaced and not list((out / ".work").iterdir())
