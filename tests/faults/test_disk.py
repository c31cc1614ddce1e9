"""Disks that fill up, at every write: one line, status 4, older outputs and checkpoints whole, nothing half written."""

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import faults_kit as kit
import numpy as np
import pytest

from phyradgs_cl.api import ConeGeometry, fly_scan
from phyradgs_cl.errors import OutputError
from phyradgs_cl.exporters import export_stored
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import Volume, read_checkpoint, write_checkpoint, write_scan, write_volume
from phyradgs_cl.workflow.sweep import append_line, read_lines

ARRAYS = {"volume": np.arange(5000, dtype=np.float32), "iteration": np.array(3)}
GRID = Grid.cube(4, 2.0)


class FullAt:
    """System calls of writing that say ENOSPC at call number ``at``, wherever it is made."""

    CALLS = ("open", "write", "fsync", "replace", "posix_fallocate")

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.made, self.at = 0, None
        for name in self.CALLS:
            monkeypatch.setattr(os, name, self._counting(getattr(os, name)))

    def _counting(self, call: Callable[..., object]) -> Callable[..., object]:
        def counted(*arguments: object, **options: object) -> object:
            self.made += 1
            if self.made == self.at:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return call(*arguments, **options)

        return counted

    def arm(self, at: int | None) -> None:
        self.made, self.at = 0, at


SCAN = fly_scan(np.zeros((2, 3, 4), np.float32), ConeGeometry(5.0, 7.0, (3, 4), 0.2), [0.0, 9.0], exposure_deg=5.0)
WRITERS: dict[str, Callable[[Path, int], None]] = {
    "checkpoint": lambda path, n: write_checkpoint(path, {**ARRAYS, "n": np.array(n)}),
    "volume": lambda path, n: write_volume(path, np.full((4, 4, 4), n, np.float32), GRID, {"n": n}),
    "scan": lambda path, n: write_scan(path, replace(SCAN, title=str(n))),
    "export.mha": lambda path, n: export_stored(Volume(np.full((4, 4, 4), n, np.float32), GRID, {}), "mha", path, ""),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_no_room_at_any_call_leaves_the_old_file_or_the_new_one(tmp_path, monkeypatch, kind) -> None:
    target = tmp_path / kind
    full = FullAt(monkeypatch)
    WRITERS[kind](target, 1)
    calls, old = full.made, target.read_bytes()
    assert calls >= 4
    for at in range(1, calls + 1):
        full.arm(at)
        try:
            WRITERS[kind](target, 2)
            full.arm(None)
            assert target.read_bytes() != old  # only the folder was not flushed
            WRITERS[kind](target, 1)
            old = target.read_bytes()
        except OutputError as error:
            full.arm(None)
            assert "no room left" in str(error) or "No space left" in str(error)
            assert target.read_bytes() == old and (kind != "checkpoint" or read_checkpoint(target))
        assert kit.names(tmp_path) == [kind]


@pytest.mark.slow
def test_results_keep_their_lines_when_there_is_no_room(tmp_path, monkeypatch) -> None:
    results = tmp_path / "results.jsonl"
    full = FullAt(monkeypatch)
    append_line(results, {"run": "one"})
    for at in range(1, full.made + 1):
        full.arm(at)
        with pytest.raises(OutputError, match="No space left"):
            append_line(results, {"run": "two"})
        full.arm(None)
        assert read_lines(results)[0] == {"run": "one"}


def can_mount() -> bool:
    """Whether a process may have a mount of its own."""
    script = ["unshare", "--mount", "mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", "/mnt"]
    try:
        return subprocess.run(script, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


# A real small disk, mounted where only this process sees it.
ON_A_DISK = """
mount -t tmpfs -o size=$1 tmpfs "$2" || exit 99
printf 'an older result' > "$2/v.h5"
shift; folder=$1; shift
"$@"; status=$?
content=new; grep -q 'an older result' "$folder/v.h5" && content=old
printf '%s|%s|%s\\n' "$status" "$(ls -A "$folder" | tr '\\n' ' ')" "$content"
"""


@pytest.mark.slow
@pytest.mark.skipif(not can_mount(), reason="a mount needs the superuser")
@pytest.mark.parametrize("size_kib", [8, 1024])
def test_a_disk_that_is_full(scan, tmp_path, size_kib) -> None:
    """The real thing: HDF5 and the checkpoints run into it by themselves."""
    script = tmp_path / "on_a_disk.sh"
    script.write_text(ON_A_DISK)
    disk = tmp_path / "disk"
    disk.mkdir()
    words = ["reconstruct", str(scan), "-o", str(disk / "v.h5"), "--method", "sirt", "--iterations", "3"]
    command = ["unshare", "--mount", "sh", str(script), f"{size_kib}k", str(disk)]
    command += [sys.executable, "-m", "phyradgs_cl", *words, "--checkpoint-every", "1e-6"]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, timeout=300)
    status, left, content = done.stdout.splitlines()[-1].split("|")
    complaints = [line for line in done.stderr.splitlines() if line.startswith("phyradgs:")]
    assert "Traceback" not in done.stderr
    if size_kib == 1024:
        assert (status, left.split(), content) == ("0", ["v.h5"], "new"), done.stderr
        return
    assert (status, content, len(complaints)) == ("4", "old", 1), done.stderr
    assert "no room left" in complaints[0]
    assert set(left.split()) <= {"v.h5", "v.h5.checkpoint.npz"}
