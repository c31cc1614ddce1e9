"""Disks that fill up, at every write: one line, status 4, older outputs and checkpoints whole, nothing half written."""

import errno
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import faults_kit as kit
import numpy as np
import pytest
from tables.results import append_line, read_lines

from phyradgs_cl.errors import OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import read_checkpoint, write_checkpoint, write_volume

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


WRITERS: dict[str, Callable[[Path, int], None]] = {
    "checkpoint": lambda path, n: write_checkpoint(path, {**ARRAYS, "n": np.array(n)}),
    "volume": lambda path, n: write_volume(path, np.full((4, 4, 4), n, np.float32), GRID, {"n": n}),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_no_room_at_any_call_leaves_the_old_file_or_the_new_one(tmp_path, monkeypatch, kind) -> None:
    target = tmp_path / "output"
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
        assert kit.names(tmp_path) == ["output"]


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


# In a process of its own, which may not write files of more bytes than this: a disk that is full at that byte.
LIMITED = """
import json, resource, sys
from pathlib import Path
from phyradgs_cl.__main__ import load_cli
run, output = load_cli().run, Path(sys.argv[1])
for limit_bytes in json.loads(sys.argv[2]):
    before = {path.name: path.read_bytes() for path in output.parent.iterdir()}
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, resource.RLIM_INFINITY))
    status = run(sys.argv[3:])
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    after = {path.name: path.read_bytes() for path in output.parent.iterdir()}
    print(json.dumps([limit_bytes, status, before == after]), flush=True)
    for name in set(after) - set(before):
        (output.parent / name).unlink()
    for name, content in before.items():
        (output.parent / name).write_bytes(content)
"""


@pytest.fixture(scope="module")
def volume(run, scan, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("volume") / "volume.h5"
    assert run("reconstruct", scan, "--method", "fdk", "-o", path) == 0
    return path


# without a device: the limit would hit PoCL's cache of kernels too
COMMANDS = {
    "simulate": ["simulate", "--phantom", "shepp-logan", *kit.TINY[2:], "-o", "{out}.h5"],
    "export": ["export", "{volume}", "--to", "mha", "-o", "{out}.mha"],
    "export of slices": ["export", "{volume}", "--to", "nrrd", "-o", "{out}.nrrd"],
}


@pytest.mark.skipif(os.name != "posix", reason="file size limits of POSIX")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_that_may_not_grow(run, scan, volume, tmp_path, name) -> None:
    words = [w.format(scan=scan, volume=volume, out=tmp_path / "existing") for w in COMMANDS[name]]
    output = Path(words[-1])
    assert run(*words) == 0
    whole_bytes = output.stat().st_size
    output.write_bytes(kit.OLD)
    limits = [0, 1, 100, *np.linspace(0.05, 0.99, 8) * whole_bytes]
    answers = _limited(output, [int(n) for n in limits], words)
    for limit, status, same in answers[0]:
        assert (status, same) == (4, True), (limit, answers[1])
    assert len(answers[0]) == len(limits)
    lines = [line for line in answers[1].splitlines() if line.startswith("phyradgs:")]
    assert len(lines) == len(limits) and "Traceback" not in answers[1]
    assert all(output.name in line for line in lines)


def _limited(output: Path, limits: list[int], words: list[str]) -> tuple[list[list[object]], str]:
    command = [sys.executable, "-c", LIMITED, str(output), json.dumps(limits), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")], done.stderr


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


@pytest.mark.skipif(not can_mount(), reason="a mount needs the superuser")
@pytest.mark.parametrize("size_kib", [8, 24, 1024])
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
