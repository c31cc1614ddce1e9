"""The commands, run as a user would, in a process of their own or through the same entry point."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from phyradgs_cl.__main__ import load_cli

SIMULATE = ["simulate", "--phantom", "jaw", "--size", "16", "--detector", "24", "--views", "6", "--time-samples", "4"]


def facts_of(volume: Path) -> dict[str, Any]:
    """The provenance of a volume, as it is stored."""
    with h5py.File(volume) as file:
        return json.loads(file["entry/provenance/json"][()])


@pytest.fixture(scope="module")
def scan(simulated):
    return simulated(*SIMULATE[1:], "--noise", "tigre")


def test_help_shows_every_command_with_an_example(cli, capsys):
    commands = ("simulate", "import", "reconstruct", "estimate", "evaluate", "report", "export", "bench")
    for command in (*commands, "info", "devices"):
        assert cli.run([command, "--help"]) == 0
        assert f"Example: phyradgs {command}" in capsys.readouterr().out


@pytest.mark.parametrize(
    "options",
    [
        ["--method", "fdk"],
        ["--method", "r2", "--iterations", "30"],
        ["--method", "phyradgs", "--motion", "static", "--iterations", "30"],
        ["--iterations", "30", "--strips", "3", "--sub-intervals", "2"],
    ],
)
def test_each_method_writes_a_volume_that_evaluates(cli, scan, tmp_path, capsys, options):
    output = tmp_path / "volume.h5"
    assert cli.run(["reconstruct", str(scan), "-o", str(output), *options]) == 0
    capsys.readouterr()
    assert cli.run(["evaluate", str(output), "--reference", str(scan), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert np.isfinite(facts["psnr_db"])
    assert 0 < facts["ssim"] <= 1
    assert Path(facts["picture"]).stat().st_size > 1000
    assert cli.run(["info", str(output)]) == 0
    told = capsys.readouterr().out
    assert "voxel size mm" in told
    wanted = options[options.index("--motion") + 1] if "--motion" in options else ""
    assert re.search(rf"^motion +{wanted}", told, re.M)
    assert ("iterations asked" in told) == ("--iterations" in options)


def test_a_method_that_ends_by_itself_says_when_and_why(cli, scan, tmp_path, capsys):
    files = [str(scan), "-o", str(tmp_path / "v.h5")]
    command = ["reconstruct", *files, "--method", "sirt", "--iterations", "9"]
    assert cli.run([*command, "--set", "tolerance=0.9"]) == 0
    assert "sirt, stopped after 2 of 9 iterations (tolerance), " in capsys.readouterr().out
    assert cli.run(command) == 0
    assert "stopped" not in capsys.readouterr().out


def test_columns_and_intensity_and_jitter_are_simulated(cli, tmp_path):
    path = tmp_path / "scan.h5"
    options = ["--readout", "columns", "--readout-direction", "-1", "--detector-model", "intensity", "--jitter-deg", "0.2"]
    options += ["--noise", "beer", "--peak", "3", "--detector-offset", "0.1,-0.2"]
    assert cli.run([*SIMULATE, *options, "-o", str(path)]) == 0
    with h5py.File(path) as file:
        own = file["entry/phyradgs"]
        assert own["readout_axis"][()].decode() == "columns"
        assert own["readout_direction"][()] == -1
        assert own["detector_model"][()].decode() == "intensity"
        assert "kinematics" in own
    assert cli.run(["reconstruct", str(path), "-o", str(tmp_path / "v.h5"), "--iterations", "5"]) == 0


@pytest.mark.parametrize(
    "options",
    [
        ["--method", "fdk"],
        ["--method", "phyradgs", "--motion", "static", "--iterations", "1"],
        ["--method", "sart", "--motion", "micro-views", "--iterations", "1"],
        ["--method", "sart", "--iterations", "1", "--detector-model", "log"],
    ],
)
def test_one_pose_a_line_and_methods_with_the_intensity_model_need_no_warning(cli, tmp_path, caplog, options):
    path = tmp_path / "scan.h5"
    assert cli.run([*SIMULATE, "--detector-model", "intensity", "-o", str(path)]) == 0
    assert cli.run(["reconstruct", str(path), "-o", str(tmp_path / "v.h5"), *options]) == 0
    assert "averages intensity" not in caplog.text


def test_a_detector_model_belongs_to_the_methods_that_have_one(cli, scan, tmp_path, capsys):
    options = ["--method", "fdk", "--detector-model", "intensity"]
    assert cli.run(["reconstruct", str(scan), "-o", str(tmp_path / "v.h5"), *options]) == 2
    assert "--detector-model: found no such option of --method fdk" in capsys.readouterr().err


def test_pulse_and_lag_are_simulated_and_the_lag_may_be_ignored(cli, tmp_path):
    path, volumes = tmp_path / "scan.h5", []
    assert cli.run([*SIMULATE, "--pulse", "0.86,0.14", "--lag", "0.1", "-o", str(path)]) == 0
    with h5py.File(path) as file:
        own = file["entry/phyradgs"]
        assert (own["pulse_start"][()], own["pulse_length"][()], own["lag"][()]) == (0.86, 0.14, 0.1)
    for options in ([], ["--ignore-lag"], ["--median-filter", "3"], ["--set", "median_filter=3"]):
        output = tmp_path / "volume.h5"
        assert cli.run(["reconstruct", str(path), "-o", str(output), "--method", "fdk", *options]) == 0
        with h5py.File(output) as file:
            volumes.append(file["entry/reconstruction/volume"][()])
            facts = json.loads(file["entry/provenance/json"][()])
        assert facts["input"]["ignore_lag"] == ("--ignore-lag" in options)
    assert np.abs(volumes[0] - volumes[1]).max() > 0 and np.abs(volumes[0] - volumes[2]).max() > 0
    np.testing.assert_array_equal(volumes[2], volumes[3])


@pytest.mark.parametrize("pulse", ["0.5", "a,b", "0,0", "5,1"])
def test_impossible_pulses_are_named(cli, tmp_path, capsys, pulse):
    assert cli.run([*SIMULATE, "--pulse", pulse, "-o", str(tmp_path / "scan.h5")]) == 2
    assert "pulse" in capsys.readouterr().err


def test_simulating_twice_with_one_seed_gives_the_same_frames(cli, tmp_path):
    frames = []
    for run, seed in enumerate((3, 3, 4)):
        path = tmp_path / f"{run}.h5"
        assert cli.run([*SIMULATE, "--noise", "tigre", "--seed", str(seed), "-o", str(path)]) == 0
        with h5py.File(path) as file:
            frames.append(file["entry/instrument/detector/data"][()])
    np.testing.assert_array_equal(frames[0], frames[1])
    assert np.abs(frames[0] - frames[2]).max() > 0


def test_the_command_line_wins_over_the_config_file(cli, scan, tmp_path):
    config = tmp_path / "run.toml"
    config.write_text("iterations = 7\ngaussians = 50\nmotion = 'static'\n[rates]\nposition = [1e-3, 1e-4]\n")
    output = tmp_path / "volume.h5"
    given = ["--config", str(config), "--iterations", "4"]
    assert cli.run(["reconstruct", str(scan), "-o", str(output), *given]) == 0
    options = facts_of(output)["options"]
    assert options["iterations"] == 4
    assert options["gaussians"] == 50
    assert options["motion"]["name"] == "static"
    assert options["rates"]["position"] == [1e-3, 1e-4]


def test_without_a_command_the_help_is_printed_as_it_is(cli, capsys):
    assert cli.run([]) == 0
    captured = capsys.readouterr()
    assert "Usage:" in captured.out
    assert len(captured.out.splitlines()) > 10
    assert captured.err == ""


def test_numbers_of_a_config_may_be_written_as_whole_floats(cli, scan, tmp_path):
    config, output = tmp_path / "run.toml", tmp_path / "volume.h5"
    config.write_text("device = 0\nseed = 3.0\nstrips = 2.0\nsub_intervals = 3\niterations = 2.0\n")
    assert cli.run(["reconstruct", str(scan), "-o", str(output), "--config", str(config)]) == 0
    facts = facts_of(output)
    motion = facts["options"]["motion"]
    assert (motion["name"], motion["strips"], motion["sub_intervals"]) == ("micro-views", 2, 3)
    assert (facts["seed"], facts["options"]["iterations"]) == (3, 2)


def test_more_gaussians_than_voxels_are_said_and_kept(cli, scan, tmp_path, caplog):
    output = tmp_path / "volume.h5"
    asked = ["--iterations", "1", "--gaussians", "100000"]
    assert cli.run(["reconstruct", str(scan), "-o", str(output), *asked]) == 0
    facts = facts_of(output)
    assert facts["gaussians_asked"] == 100_000
    assert 0 < facts["gaussians_first"] < 16**3
    assert [r.getMessage() for r in caplog.records if "asked for" in r.getMessage()] == [
        f"100000 Gaussians asked for, {facts['gaussians_first']} voxels of the first volume attenuate enough: "
        f"starting with {facts['gaussians_first']}"
    ]


def test_beams_that_miss_and_scans_without_an_object_are_said(cli, tmp_path, caplog):
    path = tmp_path / "scan.h5"
    assert cli.run([*SIMULATE, "--detector-offset", "500,500", "-o", str(path)]) == 0
    assert [r.getMessage() for r in caplog.records] == [
        "no ray meets anything that attenuates: all 6 frames are empty"
    ]
    for value in (0.0, -1.0):
        with h5py.File(path, "r+") as file:
            file["entry/instrument/detector/data"][...] = value
        caplog.clear()
        assert cli.run(["reconstruct", str(path), "-o", str(tmp_path / "v.h5"), "--method", "fdk"]) == 0
        told = [r.getMessage() for r in caplog.records if "no line integral is above 0" in r.getMessage()]
        assert len(told) == 1
        assert f"the largest is {value:g}" in told[0]


@pytest.mark.parametrize("method", ["fdk", "phyradgs"])
def test_overflow_is_one_line_without_numpys_warnings(cli, scan, tmp_path, capfd, recwarn, method):
    path = tmp_path / "scan.h5"
    shutil.copy(scan, path)
    with h5py.File(path, "r+") as file:
        file["entry/instrument/detector/data"][...] = 3e38
    capfd.readouterr()
    assert cli.run(["reconstruct", str(path), "-o", str(tmp_path / "v.h5"), "--method", method]) in (2, 3)
    assert capfd.readouterr().err.count("\n") == 1
    assert not recwarn.list


def test_volume_files_are_simulated_at_their_own_resolution(cli, tmp_path):
    source = tmp_path / "bare.h5"
    volume = np.zeros((24, 24, 24), np.uint8)
    volume[6:18, 8:16, 9:15] = 200
    with h5py.File(source, "w") as file:
        file["volume"] = volume
    path = tmp_path / "scan.h5"
    options = ["--size", "12", "--detector", "20", "--views", "4", "--protocol", "static"]
    assert cli.run(["simulate", "--volume", str(source), *options, "-o", str(path)]) == 0
    with h5py.File(path) as file:
        reference = file["entry/phyradgs/reference/volume"][()]
    block = (volume / 255).reshape(12, 2, 12, 2, 12, 2).mean((1, 3, 5))
    np.testing.assert_allclose(reference, block, atol=1e-6)


def test_devices_names_the_choice_and_the_reason(cli, capsys):
    assert cli.run(["devices"]) == 0
    text = capsys.readouterr().out
    assert "vector width" in text
    assert "takes" in text


def test_the_module_runs_outside_the_repository(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(Path(load_cli().__file__).parent)}
    command = [sys.executable, "-m", "phyradgs_cl", "--version"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stdout.startswith("phyradgs-cl ")


def test_assignments_win_over_the_file_and_switches_over_both(cli, scan, tmp_path):
    config, output = tmp_path / "run.toml", tmp_path / "volume.h5"
    config.write_text("method = 'sart'\niterations = 7\nrelaxation = 0.1\norder = 'ordered'\n")
    given = ["--set", "relaxation=0.5", "--set", "order=random", "--set", "iterations=5", "--iterations", "2"]
    assert cli.run(["reconstruct", str(scan), "-o", str(output), "--config", str(config), *given]) == 0
    options = facts_of(output)["options"]
    assert (options["relaxation"], options["order"], options["iterations"]) == (0.5, "random", 2)


def test_an_assignment_reaches_into_a_table_of_the_file(cli, scan, tmp_path):
    config, output = tmp_path / "run.toml", tmp_path / "volume.h5"
    config.write_text("iterations = 2\n[rates]\nposition = [1e-3, 1e-4]\ndensity = [1e-2, 1e-3]\n")
    given = ["--config", str(config), "--set", "rates.position=[2e-3, 2e-4]"]
    assert cli.run(["reconstruct", str(scan), "-o", str(output), *given]) == 0
    rates = facts_of(output)["options"]["rates"]
    assert rates["position"] == [2e-3, 2e-4]
    assert rates["density"] == [1e-2, 1e-3]
