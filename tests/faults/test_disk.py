"""Disks that fill up, at every write: one line, status 4, older outputs and checkpoints whole, nothing half written."""

import errno
import os
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
    target, full = tmp_path / kind, FullAt(monkeypatch)
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
    results, full = tmp_path / "results.jsonl", FullAt(monkeypatch)
    append_line(results, {"run": "one"})
    for at in range(1, full.made + 1):
        full.arm(at)
        with pytest.raises(OutputError, match="No space left"):
            append_line(results, {"run": "two"})
        full.arm(None)
        assert read_lines(results)[0] == {"run": "one"}
