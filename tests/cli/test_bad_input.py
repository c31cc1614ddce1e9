"""Bad input: one line that names the culprit, exit status 2, nothing written, an existing output untouched."""

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest


@pytest.fixture(scope="module")
def good_scan(simulated):
    options = "--phantom jaw --size 8 --detector 12 --views 4 --jitter-deg 0.1 --time-samples 2"
    return simulated(*options.split())


# name: (address below /entry, what is put there instead, words of the refusal); tests/io has all that a scan can have wrong
DAMAGE = {
    "missing data": ("instrument/detector/data", None, "detector/data"),
    "flat data": ("instrument/detector/data", np.zeros(7, np.float32), "detector/data"),
    "text data": ("instrument/detector/data", "projections", "detector/data"),
    "no projection": ("instrument/detector/image_key", np.ones(4, np.int32), "image_key"),
    "negative pitch": ("instrument/detector/x_pixel_size", -0.3, "x_pixel_size"),
    "zero distance": ("instrument/source/distance", 0.0, "source/distance"),
    "NaN distance": ("instrument/detector/distance", np.nan, "detector/distance"),
    "too few angles": ("sample/rotation_angle", np.zeros(3), "rotation_angle"),
    "empty grid": ("phyradgs/grid/shape", np.array([0, 8, 8]), "grid/shape"),
    "wrong reference": ("phyradgs/reference/volume", np.zeros((2, 2, 2)), "reference"),
    "reference of nothing": (
        "phyradgs/reference/volume", np.zeros((8, 8, 8), np.float32), "reference/volume: found no voxel above 0"
    ),
    "wrong axis": ("phyradgs/readout_axis", "diagonal", "readout_axis"),
    "exposure of nothing": ("instrument/detector/count_time", 5e-324, "detector/count_time: found 4.94066e-324 s"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_scans(cli, good_scan, tmp_path, capfd, name):
    address, value, culprit = DAMAGE[name]
    scan = tmp_path / "scan.h5"
    shutil.copy(good_scan, scan)
    with h5py.File(scan, "r+") as file:
        attributes = dict(file[f"entry/{address}"].attrs)
        del file[f"entry/{address}"]
        if value is not None:
            file.create_dataset(f"entry/{address}", data=value).attrs.update(attributes)
    _expect_refusal(cli, capfd, tmp_path, ["reconstruct", str(scan), "--iterations", "2"], culprit)


TINY = ["--size", "8", "--detector", "8"]
OPTIONS = {
    "no such scan": ("reconstruct {tmp}/none.h5", "none.h5"),
    "not HDF5": ("reconstruct {text}", "text.h5"),
    "no such device": ("reconstruct {scan} --device abacus", "abacus"),
    "no such method": ("reconstruct {scan} --method magic", "--method"),
    "no such motion": ("reconstruct {scan} --motion wobble", "--motion"),
    "strips without micro-views": ("reconstruct {scan} --motion static --strips 4", "--strips"),
    "no strips": ("reconstruct {scan} --strips 0", "strips"),
    "far too many strips": ("reconstruct {scan} --strips 1000000000", "strips"),
    "far too many views": ("simulate --views 1000000000", "views"),
    "far too large": ("simulate --size 100000 --detector 8", "--size"),
    "size of nothing": ("simulate --size 0 --detector 8", "--size"),
    "negative seed of a scan": ("simulate --seed -1 --size 8 --detector 8", "--seed"),
    "start at NaN": ("simulate --start-deg nan --size 8 --detector 8", "start"),
    "direction 0": ("simulate --readout-direction 0 --size 8 --detector 8", "direction"),
    "negative iterations": ("reconstruct {scan} --iterations -5", "--iterations"),
    "iterations of fdk": ("reconstruct {scan} --method fdk --iterations 5", "iterations"),
    "micro-views of fdk": ("reconstruct {scan} --method fdk --motion micro-views", "--motion"),
    "no such preset": ("reconstruct {scan} --preset best", "--preset"),
    "negative seed": ("reconstruct {scan} --seed -1", "seed"),
    "missing config": ("reconstruct {scan} --config {tmp}/none.toml", "none.toml"),
    "config that never ends": ("reconstruct {scan} --config /dev/zero", "/dev/zero"),
    "config that is not TOML": ("reconstruct {scan} --config {text}", "text.h5"),
    "resume without checkpoint": ("reconstruct {scan} --resume", "--resume"),
    "unknown option": ("reconstruct {scan} --iteration-count 5", "--iteration-count"),
    "no such phantom": ("simulate --phantom elephant", "--phantom"),
    "no such volume": ("simulate --volume {tmp}/none.h5", "none.h5"),
    "phantom and volume": ("simulate --phantom foot --volume {scan}", "--volume"),
    "no such scanner": ("simulate --scanner r3", "r3"),
    "no views": ("simulate --views 0", "views"),
    "negative exposure": ("simulate --exposure-deg -3", "exposure"),
    "no dose": ("simulate --noise beer --dose 0 --size 8 --detector 8", "--dose"),
    "dose without noise": ("simulate --dose 100 --size 8 --detector 8", "--dose 100: found --noise none"),
    "electronic noise without noise": (
        "simulate --electronic-noise 5 --size 8 --detector 8",
        "--electronic-noise 5",
    ),
    "median of three and a half": ("reconstruct {scan} --median-filter 4", "--median-filter: found 4"),
    "iterations that are no number": ("reconstruct {scan} --iterations 1e3", "'1e3'"),
    "dose that is no number": ("simulate --noise beer --dose=1o --size 8 --detector 8", "found '1o'"),
    "bad offset": ("simulate --detector-offset left", "--detector-offset"),
    "bad size": ("simulate --size -4 --detector 8", ""),
    "wrong direction": ("simulate --readout-direction 2 --size 8 --detector 8", "direction"),
    "a word for a number": ("simulate --views many", "--views"),
    "sub-intervals of fdk": (
        "reconstruct {scan} --method fdk --motion per-row --sub-intervals 3",
        "--sub-intervals",
    ),
    "jitter of a standing gantry": ("simulate --protocol static --jitter-deg 0.1", "--jitter-deg"),
    "assignment without a value": ("reconstruct {scan} --set tv_weight", "--set"),
    "assignment that is not TOML": ("reconstruct {scan} --set 'x y=3'", "--set"),
    "assignment of no such option": ("reconstruct {scan} --set tv_weigth=3", "tv_weight"),
    "assignment of a word to a number": ("reconstruct {scan} --set tv_weight=much", "tv_weight"),
    "assignment of no such method": ("reconstruct {scan} --set method=magic", "magic"),
    "views that are no whole number": ("simulate --views 1e23", "--views"),
    "seed of a scan beyond 64 bits": ("simulate --seed " + "9" * 30 + " --size 8 --detector 8", "--seed"),
    "endless seed": ("reconstruct {scan} --seed " + "9" * 400, "--seed"),
    "endless detector": ("simulate --detector " + "9" * 400, "--detector"),
    "endless size": ("simulate --size " + "9" * 400 + " --detector 8", "--size"),
    "endless strips": ("reconstruct {scan} --strips " + "9" * 400, "strips"),
    "a number too long to read": ("simulate --views " + "9" * 5000, "--views"),
    "offset at infinity": ("simulate --detector-offset 0,inf", "--detector-offset"),
    "no file name": ("reconstruct '' --method fdk", "SCAN"),
    "no volume name": ("simulate --volume ''", "--volume"),
    "no config name": ("reconstruct {scan} --config ''", "--config"),
    "no device name": ("reconstruct {scan} --device ''", "--device"),
    "blank device name": ("simulate --device ' ' --size 8 --detector 8", "--device"),
    "no preset name": ("reconstruct {scan} --preset ''", "--preset"),
    "strips of fdk": ("reconstruct {scan} --method fdk --strips 4", "--strips"),
    "exact line times of splats": ("reconstruct {scan} --motion per-row", "--motion"),
    "seed that is no number": ("reconstruct {scan} --seed 1.5", "--seed"),
    "grid of three words": ("reconstruct {scan} --size a,b,c", "--size: found 'a,b,c'"),
    "grid of nothing": ("reconstruct {scan} --size 0", "--size: found 0"),
    "voxels of no size": ("reconstruct {scan} --voxel-mm -1", "--voxel-mm: found -1.0"),
    "far too many voxels": ("reconstruct {scan} --voxel-mm 1e-8", "--voxel-mm: found a grid of"),
    "box that ends first": ("reconstruct {scan} --roi 1,-1,-1,1,-1,1", "--roi-mm"),
    "box beyond the view": ("reconstruct {scan} --roi 90,91,-1,1,-1,1", "the field of view"),
    "grid said three times": (
        "reconstruct {scan} --size 4 --voxel-mm 1 --roi -1,1,-1,1,-1,1",
        "--size: found all three",
    ),
    "import of a grid of nothing": ("import {scan} --size 0", "--size: found 0"),
    "scanner that is a configuration": ("simulate --scanner demo", "scanner"),
}
ABSURD_VALUES = {
    "--dose": ("1e300", "1e13", "nan", "inf", "-1", "0"),
    "--electronic-noise": ("1e300", "1e10", "nan", "inf", "-1"),
    "--jitter-deg": ("1e300", "361", "nan", "inf", "-1"),
    "--peak": ("1e300", "1e5", "nan", "inf", "-1"),
    "--exposure-deg": ("1e300", "nan", "inf", "-1"),
    "--start-deg": ("1e300", "-1e300", "1e7", "nan", "inf"),
    "--readout-ratio": ("1e300", "nan", "inf", "-1"),
    "--detector-offset": ("1e300,0", "0,-1e7", "nan,0", "0", "1,2,3"),
    "--detector": ("99999999999999999999", "-1", "0"),
    "--views": ("99999999999999999999", "-1", "0"),
    "--size": ("99999999999999999999", "-1", "0"),
    "--time-samples": ("99999999999999999999", "-1"),
    "--seed": ("99999999999999999999", "-1"),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_wrong_options(cli, good_scan, tmp_path, capfd, name):
    arguments, culprit = OPTIONS[name]
    text = tmp_path / "text.h5"
    text.write_text("this is [not a table")
    filled = [word.format(tmp=tmp_path, scan=good_scan, text=text) for word in shlex.split(arguments)]
    _expect_refusal(cli, capfd, tmp_path, filled, culprit)


@pytest.mark.parametrize("option", ABSURD_VALUES)
def test_absurd_numbers_of_a_simulation(cli, tmp_path, capfd, option):
    word = option.strip("-").split("-")[0]
    for value in ABSURD_VALUES[option]:
        arguments = ["simulate", "--noise", "beer", *TINY, f"{option}={value}"]
        _expect_refusal(cli, capfd, tmp_path, arguments, word)


CONFIGS = {
    "unknown key": ("iteration = 5", "iteration"),
    "text for a number": ("iterations = 'many'", "iterations"),
    "half a Gaussian": ("gaussians = 10.5", "gaussians"),
    "number for a table": ("rates = 3", "rates"),
    "short pair": ("[rates]\nposition = [1e-3]", "position"),
    "boolean weight": ("tv_weight = true", "tv_weight"),
    "NaN weight": ("tv_weight = nan", "tv_weight"),
    "infinite iterations": ("iterations = inf", "iterations"),
    "NaN iterations": ("iterations = nan", "iterations"),
    "negative weight": ("ssim_weight = -0.5", "ssim_weight"),
    "huge weight": ("density_weight = 1e300", "density_weight"),
    "rate of nothing": ("[rates]\nscale = [0, 0]", "rates.scale"),
    "NaN rate": ("[rates]\nposition = [nan, 1e-4]", "position"),
    "negative threshold": ("[control]\nthreshold = -1", "control.threshold"),
    "negative period": ("[control]\nevery = -1", "control.every"),
    "half a period": ("[control]\nevery = 0.5", "every"),
    "unknown key of a table": ("[control]\nevry = 3", "did you mean 'every'?"),
    "scales the wrong way round": ("scale_min = 0.5\nscale_max = 0.1", "scale_max"),
    "list of presets": ("preset = ['default']", "preset"),
    "list of devices": ("device = [0]", "device"),
    "negative device": ("device = -1", "device"),
    "empty device": ("device = ''", "device"),
    "boolean device": ("device = true", "device"),
    "list of methods": ("method = ['fdk']", "method"),
    "number for a method": ("method = 3", "method"),
    "list of motions": ("motion = ['static']", "motion"),
    "number for a motion": ("motion = 3", "motion"),
    "half a strip": ("strips = 2.5", "strips"),
    "boolean strips": ("strips = true", "strips"),
    "boolean seed": ("seed = true", "seed"),
    "huge seed": ("seed = 1e300", "seed"),
    "date for a seed": ("seed = 2024-01-01", "seed"),
    "dash for an underscore": ("sub-intervals = 3", "did you mean 'sub_intervals'?"),
    "key that lacks a letter": ("strip = 3", "did you mean 'strips'?"),
    "digits without end": (f"iterations = {'9' * 5000}", "config"),
    "hexadecimal digits without end": (f"iterations = 0x{'f' * 5000}", "iterations"),
    "sizes of a grid in words": ("size = '4,4,4'", "size: found '4,4,4'"),
    "voxels of two sides": ("voxel_mm = [1, 2]", "voxel_mm: found"),
    "endless box": ("roi_mm = [-inf, inf, 0, 1, 0, 1]", "roi_mm: found"),
    "tables without end": ("a = " + "[" * 20_000, "config"),
}


@pytest.mark.parametrize("name", CONFIGS)
def test_wrong_configs(cli, good_scan, tmp_path, capfd, name):
    text, culprit = CONFIGS[name]
    config = tmp_path / "run.toml"
    config.write_text(text)
    _expect_refusal(cli, capfd, tmp_path, ["reconstruct", str(good_scan), "--config", str(config)], culprit)


def test_outputs_that_cannot_be_written(cli, good_scan, tmp_path, capfd):
    for output in (tmp_path / "nowhere" / "volume.h5", tmp_path):
        for arguments in (
            ["reconstruct", str(good_scan), "--method", "fdk"],
            ["simulate", "--size", "8", "--detector", "8"],
        ):
            assert cli.run([*arguments, "-o", str(output)]) == 4
            line = capfd.readouterr().err
            assert line.count("\n") == 1
            assert str(output) in line or str(output.parent) in line
    assert list(tmp_path.iterdir()) == []


def test_a_volume_is_not_written_under_another_formats_suffix(cli, good_scan, tmp_path, capfd):
    for name in ("v.nii", "v.nii.gz", "V.MHA"):
        assert cli.run(["reconstruct", str(good_scan), "--method", "fdk", "-o", str(tmp_path / name)]) == 2
        error = capfd.readouterr().err
        assert error.count("\n") == 1 and "another format" in error and f"export volume.h5 -o {name}" in error
        assert not (tmp_path / name).exists()


def test_the_scan_is_never_overwritten_by_its_volume(cli, good_scan, tmp_path, capfd):
    scan = tmp_path / "scan.h5"
    shutil.copy(good_scan, scan)
    before = scan.read_bytes()
    assert cli.run(["reconstruct", str(scan), "-o", str(scan), "--method", "fdk"]) == 2
    assert capfd.readouterr().err.count("\n") == 1
    assert scan.read_bytes() == before


def test_the_configuration_is_never_overwritten(cli, good_scan, tmp_path, capfd):
    config = tmp_path / "run.toml"
    config.write_text("method = 'fdk'\n")
    assert cli.run(["reconstruct", str(good_scan), "--config", str(config), "-o", str(config)]) == 2
    assert capfd.readouterr().err.count("\n") == 1
    assert config.read_text() == "method = 'fdk'\n"


def test_the_scanner_is_never_overwritten(cli, tmp_path, capfd):
    scanner = tmp_path / "own.toml"
    shutil.copy(Path(cli.__file__).parent / "data" / "r2.toml", scanner)
    before = scanner.read_bytes()
    assert cli.run(["simulate", "--scanner", str(scanner), "-o", str(scanner), *TINY]) == 2
    assert capfd.readouterr().err.count("\n") == 1
    assert scanner.read_bytes() == before


@pytest.mark.parametrize("command", [["simulate", *TINY], ["reconstruct", "scan.h5"]])
def test_an_output_without_a_name_is_said_so(cli, capfd, command):
    assert cli.run([*command, "-o", ""]) == 2
    assert capfd.readouterr().err == "phyradgs: -o: found ''; expected a file name; name a file\n"


def test_only_scanners_are_offered_for_a_misspelt_scanner(cli, tmp_path, capfd):
    for name in ("demos", "r3"):
        assert cli.run(["simulate", "--scanner", name, "-o", str(tmp_path / "scan.h5")]) == 2
        line = capfd.readouterr().err
        assert "r2" in line
        assert "demo'" not in line.replace(f"{name}'", "")
        assert "demo," not in line


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_behind_stdout_is_one_line(good_scan):
    for command in (["info", str(good_scan)], ["devices"], ["--version"], []):
        with open("/dev/full", "w") as full:
            done = subprocess.run(
                [sys.executable, "-m", "phyradgs_cl", *command],
                stdout=full,
                stderr=subprocess.PIPE,
                text=True,
            )
        assert done.returncode == 4
        assert done.stderr.startswith("phyradgs: standard output: ")
        assert done.stderr.count("\n") == 1


def _expect_refusal(cli, capfd, folder, arguments, culprit):
    output = folder / "existing.h5"
    output.write_bytes(b"an older result")
    before = sorted(p.name for p in folder.iterdir())
    capfd.readouterr()
    assert cli.run([*arguments, "-o", str(output)]) == 2
    captured = capfd.readouterr()
    lines = [line for line in captured.err.splitlines() if line.strip()]
    assert len(lines) == 1, captured.err
    assert culprit in lines[0]
    assert "Traceback" not in captured.err
    assert output.read_bytes() == b"an older result"
    assert sorted(p.name for p in folder.iterdir()) == before


def test_inputs_are_never_overwritten_by_a_picture(cli, good_scan, tmp_path, capfd):
    volume = tmp_path / "volume.h5"
    assert cli.run(["reconstruct", str(good_scan), "-o", str(volume), "--method", "fdk"]) == 0
    before = volume.read_bytes()
    capfd.readouterr()
    assert cli.run(["evaluate", str(volume), "--reference", str(good_scan), "--picture", str(volume)]) == 2
    assert capfd.readouterr().err.count("\n") == 1
    assert volume.read_bytes() == before
