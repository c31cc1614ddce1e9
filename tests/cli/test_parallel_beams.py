"""A parallel beam through the commands: from a simulated scan to its quality, and what is refused in one line."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

pytestmark = pytest.mark.slow
FLY = "--scanner parallel --phantom jaw --size 16 --detector 24 --views 20 --exposure-deg 12 --time-samples 4"


@pytest.fixture(scope="module")
def parallel(simulated) -> Path:
    return simulated(*FLY.split())


def test_from_a_simulated_scan_to_its_quality(told, parallel, tmp_path, fast_pictures) -> None:
    """Lines' own times help."""
    facts, volume, psnr_db = told("info", parallel), tmp_path / "volume.h5", []
    assert "parallel beam" in facts and "source to" not in facts and "(0.106667, 0.106667)" in facts
    for words in ("", "--motion static"):
        told(f"reconstruct {parallel} --method fbp {words} -o {volume}")
        psnr_db.append(told(f"evaluate {volume} --reference {parallel} --json")["psnr_db"])
    assert psnr_db[0] > psnr_db[1] > 26


ALONG = np.tile([0, 1.0, 0, 0, -1, -1, 0, 0.1, 0, 0, 0, 0.1], (2, 1))  # rays along the panel
FILES: dict[str, dict[str, object]] = {  # by words of the line: what the file has, None for what it lacks
    "source/distance: found a distance; expected no source distance": {"instrument/source/distance": 5.0},
    "source/distance: found 0; expected a length": {"instrument/source/distance": 0.0, "phyradgs/beam": None},
    "source/distance": {"phyradgs/beam": None}, "beam: found 'fan'": {"phyradgs/beam": "fan"},
    "rays that cross the panel": {"phyradgs/poses/time_s": [0.0, 100.0], "phyradgs/poses/pose": ALONG},
}  # fmt: skip


def test_files_that_contradict_themselves_are_refused(refused, parallel, tmp_path) -> None:
    for words, changes in FILES.items():
        with h5py.File(path := Path(shutil.copy(parallel, tmp_path / "scan.h5")), "r+") as file:
            for name, value in changes.items():
                file["entry"].pop(name, None)
                if value is not None:
                    file[f"entry/{name}"] = value
        for command in (["info", path], ["reconstruct", path, "--method", "fbp", "-o", tmp_path / "volume.h5"]):
            refused(command, words)
    assert not (tmp_path / "volume.h5").exists()


def test_each_beam_has_its_methods_and_numbers(refused, parallel, scan, tmp_path) -> None:
    output = ["-o", tmp_path / "out.h5"]
    refused(["reconstruct", parallel, "--method", "fdk", *output], "--method fdk: found a parallel beam", "--method fbp")
    refused(["reconstruct", scan, "--method", "fbp", *output], "--method fbp: found a cone beam", "--method fdk")
    refused(["reconstruct", scan, "--slab", "4", *output], "--slab: found 4; expected all rows", "--roi-mm")
    refused(["calibrate", parallel, "--what", "source-distance", *output], "--what", "parallel beam")
    refused(["prepare", parallel, "--steps", "phase", "--set", "phase.energy_kev=25", *output], "phase.")
    (toml := tmp_path / "mine.toml").write_text('[source]\nbeam = "parallel"\nto_axis_mm = 5\n[detector]\n')
    refused(["simulate", "--scanner", toml, *output], "[source] to_axis_mm: found 5; expected no distance")
    refused(["import", parallel, "--source-to-axis-mm", "5", *output], "a scan file of this package")
    assert not (tmp_path / "out.h5").exists()


def test_what_a_method_refuses_comes_before_any_warning(refused, simulated, parallel, scan, tmp_path) -> None:
    """``refused`` takes one line alone; of the same words without the fault, each gives a warning."""
    uneven, intensity = (simulated(*FLY.split(), *more.split()) for more in ("--jitter-deg 2", "--detector-model intensity"))
    for source, words, part in (
        (scan, "fbp --doubt", "--method fbp: found a cone beam"),
        (intensity, "fdk", "--method fdk: found a parallel beam"),
        (uneven, "fbp --set deblur=0.01 --doubt", "views at uneven angles"),
        (parallel, "moving --set gating=scan --doubt", "no gating in the scan"),
        (parallel, "phyradgs --set batch=99 --doubt", "no more than the scan's 20 frames"),
    ):
        refused(["reconstruct", source, "-o", tmp_path / "out.h5", "--method", *words.split()], part)
