"""Warnings where they belong and nowhere else, and files that are taken for others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from phyradgs_cl.acquisition import Exact, LineMiddles, MicroViews, Static
from phyradgs_cl.errors import OutputError
from phyradgs_cl.runtime import device, pocl
from phyradgs_cl.workflow import evaluate, load_scan, reconstruct

TINY = ["--phantom", "jaw", "--size", "8", "--detector", "12", "--views", "4", "--time-samples", "2"]


@pytest.fixture(scope="module")
def scan(simulated) -> Path:
    return simulated(*TINY, "--jitter-deg", "0.1")


@pytest.fixture
def warned(cli, scan, tmp_path, caplog):
    """What a reconstruction of a scan warns of."""

    def reconstruct(*options: str, scan: Path = scan) -> list[str]:
        caplog.clear()
        assert cli.run(["reconstruct", str(scan), "-o", str(tmp_path / "v.h5"), *options]) == 0
        return [record.getMessage() for record in caplog.records]

    return reconstruct


def test_a_threshold_above_everything_is_said(warned):
    few = ["--iterations", "1"]
    assert (
        "no voxel of the first volume is above initial_threshold 5"
        in warned(*few, "--set", "initial_threshold=5")[0]
    )
    assert warned(*few) == []


def test_more_strips_than_lines_are_said(warned):
    few = ["--iterations", "1"]
    assert warned(*few, "--strips", "12") == []
    assert warned(*few, "--strips", "13")[0].startswith("13 strips are more than the 12 lines of ")


def test_fdk_of_one_angle_is_said(cli, warned, tmp_path):
    path = tmp_path / "one.h5"
    assert cli.run(["simulate", *TINY, "--views", "1", "-o", str(path)]) == 0
    assert "all views are from one angle" in warned("--method", "fdk", scan=path)[0]


def test_frames_that_do_not_follow_each_other_are_said(warned, scan, tmp_path):
    path = tmp_path / "swapped.h5"
    path.write_bytes(scan.read_bytes())
    with h5py.File(path, "r+") as file:
        times = file["entry/instrument/detector/frame_start_time"]
        times[...] = np.sort(times[()])[[0, 2, 1, 3]]
    assert any(
        "frame 2 starts no later than frame 1" in line for line in warned("--method", "fdk", scan=path)
    )
    assert warned("--method", "fdk") == []


@pytest.mark.parametrize(
    ("motion", "is_fly", "expected"),
    [
        (MicroViews(), True, True),
        (Exact(), True, True),
        (Static(), True, False),
        (LineMiddles(), True, False),  # one pose per line: there is nothing to average
        (MicroViews(), False, False),
    ],
)
def test_detector_models_differ_only_where_poses_are_averaged(scan, motion, is_fly, expected):
    loaded = load_scan(scan)
    object.__setattr__(loaded, "is_fly", is_fly)
    options = SimpleNamespace(motion=motion)
    assert reconstruct._averages(loaded, options) == expected


def test_files_of_another_kind_are_called_by_their_kind(cli, scan, tmp_path, capfd):
    volume, bare = tmp_path / "volume.h5", tmp_path / "bare.h5"
    assert cli.run(["reconstruct", str(scan), "-o", str(volume), "--method", "fdk"]) == 0
    with h5py.File(bare, "w") as file:
        file["volume"] = np.ones((4, 4, 4), np.uint8)
    output = ["-o", str(tmp_path / "out.h5")]
    for command, expected in (
        (["reconstruct", str(volume), *output], f"{volume}: found a volume of phyradgs-cl; expected a scan"),
        (
            ["reconstruct", str(bare), *output],
            f"{bare}: found a bare volume (dataset /volume); expected a scan",
        ),
        (["evaluate", str(scan), "--reference", str(scan)], f"{scan}: found a scan; expected a volume"),
        (["simulate", "--volume", str(scan), *output], f"{scan}: found a scan; expected a bare volume"),
    ):
        capfd.readouterr()
        assert cli.run(command) == 2
        error = capfd.readouterr().err
        assert error.startswith(f"phyradgs: {expected}")
        assert error.count("\n") == 1


def test_a_volume_at_the_resolution_of_its_grid_is_said(cli, tmp_path, caplog):
    bare = tmp_path / "bare.h5"
    with h5py.File(bare, "w") as file:
        file["volume"] = np.pad(np.full((4, 4, 4), 200, np.uint8), 2)
    command = ["simulate", "--volume", str(bare), "--detector", "8", "--views", "2", "-o"]
    assert cli.run([*command, str(tmp_path / "s.h5"), "--size", "4"]) == 0
    assert "inverse crime" not in caplog.text
    assert cli.run([*command, str(tmp_path / "s.h5")]) == 0
    assert "8×8×8 voxels are projected and a grid of 8×8×8 is to be reconstructed" in caplog.text


def test_a_damaged_checkpoint_is_called_damaged(cli, scan, tmp_path, capfd):
    output = tmp_path / "v.h5"
    Path(f"{output}.checkpoint.npz").write_text("no archive")
    assert cli.run(["reconstruct", str(scan), "-o", str(output), "--resume"]) == 2
    error = capfd.readouterr().err
    assert "found a damaged checkpoint; expected a whole one; start without --resume" in error


def test_one_voxel_is_too_few_for_a_phantom(cli, tmp_path, capfd):
    assert cli.run(["simulate", "--size", "1", "--detector", "8", "-o", str(tmp_path / "s.h5")]) == 2
    assert capfd.readouterr().err == "phyradgs: --size: found 1; expected a number from 2 to 4096\n"


def test_a_picture_without_room_is_not_left_in_part(cli, scan, tmp_path, capfd, monkeypatch):
    volume, picture = tmp_path / "volume.h5", tmp_path / "p.png"
    assert cli.run(["reconstruct", str(scan), "-o", str(volume), "--method", "fdk"]) == 0
    picture.write_bytes(b"an older picture")

    def full(path: Path, *_: object) -> None:
        Path(path).write_bytes(b"the beginning")
        raise OutputError(str(path), "no room") from OSError(28, "No space left on device")

    monkeypatch.setattr(evaluate, "slices_png", full)
    capfd.readouterr()
    command = ["evaluate", str(volume), "--reference", str(scan), "--picture", str(picture)]
    assert cli.run(command) == 4
    assert capfd.readouterr().err.startswith(f"phyradgs: {picture}: found no room left in folder")
    assert picture.read_bytes() == b"an older picture"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.png", "volume.h5"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="POSIX")
@pytest.mark.parametrize("where", [{"HOME": "/dev/null"}, {"POCL_CACHE_DIR": "/dev/null/cache"}])
def test_a_cache_that_cannot_be_written_is_replaced(tmp_path, where):
    kept = {k: v for k, v in os.environ.items() if k not in ("POCL_CACHE_DIR", "XDG_CACHE_HOME")}
    command = [sys.executable, "-m", "phyradgs_cl", "devices"]
    environment = {**kept, "TMPDIR": str(tmp_path), **where}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if "PoCL" in done.stdout:
        assert "cannot be written: kernels are kept in" in done.stderr
        assert "set POCL_CACHE_DIR" in done.stderr


def test_no_device_for_want_of_a_cache_is_said(cli, capfd, monkeypatch):
    monkeypatch.setattr(pocl, "_unwritable", Path("/full/cache"))
    monkeypatch.setattr(device, "list_devices", list)
    assert cli.run(["devices"]) == 5
    assert capfd.readouterr().err == (
        "phyradgs: OpenCL: found no device, and PoCL's cache /full/cache cannot be written; expected at least one; "
        "set POCL_CACHE_DIR to a folder that can be written\n"
    )


def test_a_reader_that_goes_away_is_no_error(scan):
    for command in ("info", "devices", "--help"):
        arguments = [
            sys.executable,
            "-m",
            "phyradgs_cl",
            command,
            *([str(scan)] if command == "info" else []),
        ]
        started = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert started.stdout is not None and started.stderr is not None
        started.stdout.close()
        assert started.stderr.read() == ""
        assert started.wait(60) == 0
