"""The commands, run as a user would through the same entry point."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from damage import changed, on

from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume

pytestmark = pytest.mark.slow
SIMULATE = ["simulate", "--phantom", "jaw", "--size", "16", "--detector", "24", "--views", "6", "--time-samples", "4"]


def facts_of(volume: Path) -> dict[str, Any]:
    """The provenance of a volume, as it is stored."""
    with h5py.File(volume) as file:
        return json.loads(file["entry/provenance/json"][()])


@pytest.fixture(scope="module")
def scan(simulated):
    return simulated(*SIMULATE[1:], "--noise", "tigre", "--seed", "3")


@pytest.fixture
def reconstructed(cli, tmp_path):
    """(scan, words...) → the volume of it."""

    def reconstruct(scan: Path, *words: str) -> Path:
        assert cli.run(["reconstruct", str(scan), "-o", str(tmp_path / "volume.h5"), *words]) == 0
        return tmp_path / "volume.h5"

    return reconstruct


def test_info_tells_tables_in_words_and_long_ones_in_few_lines(told, tmp_path):
    step = {"step": "sparks", "pixels": 3, "options": {"least": 0.1}}
    facts = {
        "prepared": [step] * 40, "doubt": {"runs": 3, "mean_per_mm": 0.0123456789, "held_out": None},
        "interrupted_at": None, "times": [0.1 * n for n in range(500)], "scan": "/" + "a-b/" * 60,
    }  # fmt: skip
    grid = Grid.cube(2, 2.0)
    write_volume(tmp_path / "v.h5", np.ones(grid.shape, np.float32), grid, facts)
    lines = (text := told("info", tmp_path / "v.h5")).splitlines()
    said = {"doubt": "runs 3, mean 0.0123457 1/mm", "times": "500 values from 0 to 49.9", "scan": facts["scan"]}
    assert {f"{key:24s} {value}" for key, value in said.items()} <= {*lines}
    (first,) = [line for line in lines if line.startswith("prepared")]
    assert first[25:].startswith("step sparks, pixels 3, options (least 0.1); step sparks, pixels 3")
    assert sum(line.startswith(" ") for line in lines) == 5 and "… (--json)" in text
    assert "interrupted" not in text and "{" not in text


def test_the_error_on_held_out_pixels_is_said_and_kept(scan, reconstructed, capsys):
    """In the file's attributes, and without a word where it was not asked for."""
    volume = reconstructed(scan, "--method", "fdk", "--holdout", "3")
    said = re.search(r"held-out RMS (\S+), noise RMS (\S+)", capsys.readouterr().out)
    with h5py.File(volume) as file:
        kept = dict(file["entry/metrics"].attrs)
    assert float(said[1]) == pytest.approx(kept["holdout_rms"], rel=1e-3)
    assert float(said[2]) == pytest.approx(kept["holdout_noise_rms"], rel=1e-3) and kept["holdout_pixels"] > 50
    assert facts_of(volume)["input"]["holdout"] == 3
    reconstructed(scan, "--method", "fdk")
    assert "held-out" not in capsys.readouterr().out


def test_a_method_that_ends_by_itself_says_when_and_why(scan, reconstructed, capsys):
    words = ["--method", "sirt", "--iterations", "9"]
    reconstructed(scan, *words, "--set", "tolerance=0.9")
    assert "sirt, motion per-row, stopped after 2 of 9 iterations (tolerance), " in capsys.readouterr().out
    reconstructed(scan, *words)
    assert "stopped" not in capsys.readouterr().out


def test_columns_intensity_jitter_pulse_and_lag_are_simulated(cli, reconstructed, tmp_path, caplog):
    path, volumes = tmp_path / "scan.h5", []
    options = "--first right --detector-model intensity --jitter-deg 0.2 --noise beer --peak 3 --lag 0.1"
    options += " --detector-offset 0.1,-0.2 --pulse 0.86,0.14"
    assert cli.run([*SIMULATE, *options.split(), "-o", str(path)]) == 0
    with h5py.File(path) as file:
        own = file["entry/phyradgs"]
        words = [own[name][()].decode() for name in ("readout_axis", "detector_model")]
        assert words == ["columns", "intensity"] and own["readout_direction"][()] == -1
        assert (own["pulse_start"][()], own["pulse_length"][()], own["lag"][()]) == (0.86, 0.14, 0.1)
        assert "kinematics" in own
    reconstructed(path, "--iterations", "5")
    for words in ([], ["--set", "ignore_lag=true"], ["--holdout", "20"], ["--set", "holdout=20"]):
        with h5py.File(reconstructed(path, "--method", "fdk", *words)) as file:
            volumes.append(file["entry/reconstruction/volume"][()])
            facts = json.loads(file["entry/provenance/json"][()])
        assert facts["input"]["ignore_lag"] == ("ignore_lag=true" in words)
    assert np.abs(volumes[0] - volumes[1]).max() > 0 and np.abs(volumes[0] - volumes[2]).max() > 0
    np.testing.assert_array_equal(volumes[2], volumes[3])
    for words in ("--motion micro-views", "--method sart --detector-model log"):
        reconstructed(path, *words.split(), "--iterations", "1")
    assert "averages intensity" not in caplog.text  # none of these merges poses without a model of intensity


def test_more_gaussians_than_voxels_are_said_and_kept(scan, reconstructed, caplog):
    facts = facts_of(reconstructed(scan, "--method", "phyradgs", "--iterations", "1", "--gaussians", "100000"))
    assert facts["gaussians_asked"] == 100_000 and 0 < facts["gaussians_first"] < 16**3
    assert caplog.text.count("100000 Gaussians asked for") == 1
    assert f"starting with {facts['gaussians_first']}" in caplog.text


def test_beams_that_miss_scans_without_an_object_and_overflow_are_said(
    cli, scan, reconstructed, tmp_path, caplog, capfd, recwarn
):
    path = tmp_path / "scan.h5"
    assert cli.run([*SIMULATE, "--detector-offset", "500,500", "-o", str(path)]) == 0
    assert caplog.messages == ["no ray meets anything that attenuates: all 6 frames are empty"]
    assert cli.run(["reconstruct", str(path), "-o", str(tmp_path / "volume.h5")]) == 2
    assert "that no ray meets in any frame" in capfd.readouterr().err
    shutil.copy(scan, path)
    for value, words in ((0.0, "all line integrals are 0"), (-1.0, "line integrals are negative on the whole, -1 on")):
        on("entry/instrument/detector/data", changed(lambda data, value=value: 0 * data + np.float32(value)))(path)
        caplog.clear()
        reconstructed(path, "--method", "fdk")
        assert sum(words in line for line in caplog.messages) == 1
    on("entry/instrument/detector/data", changed(lambda data: 0 * data + np.float32(3e38)))(path)
    capfd.readouterr()
    assert cli.run(["reconstruct", str(path), "-o", str(tmp_path / "v.h5"), "--method", "fdk"]) in (2, 3)
    assert capfd.readouterr().err.count("\n") == 1 and not recwarn.list  # of NumPy


def test_volume_files_are_simulated_at_their_own_resolution(cli, tmp_path, caplog):
    source, path = tmp_path / "bare.h5", tmp_path / "scan.h5"
    volume = np.zeros((24, 24, 24), np.uint8)
    volume[6:18, 8:16, 9:15] = 200
    with h5py.File(source, "w") as file:
        file["volume"] = volume
    command = ["simulate", "--volume", str(source), "--detector", "9", "--views", "4", "--protocol", "static"]
    assert cli.run([*command, "--size", "12", "-o", str(path)]) == 0
    with h5py.File(path) as file:
        reference = file["entry/phyradgs/reference/volume"][()]
    np.testing.assert_allclose(reference, (volume / 255).reshape(12, 2, 12, 2, 12, 2).mean((1, 3, 5)), atol=1e-6)
    assert "inverse crime" not in caplog.text
    assert cli.run([*command, "--lag", "0.1", "-o", str(path)]) == 0
    assert "24×24×24 voxels are projected and a grid of 24×24×24 is to be reconstructed" in caplog.text
