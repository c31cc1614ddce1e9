"""Bad input, and words that have left: one line, exit status 2, nothing written, an existing output untouched."""

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from phyradgs_cl.removed import REMOVED

pytestmark = pytest.mark.slow
OLD = b"an older result"
DIGITS = "9" * 400
SMALL = "--size 8 --detector 8"


@pytest.fixture
def kept(refused, tmp_path):
    """As ``refused``, beside an older output that stays as it is."""
    output = tmp_path / "existing.h5"

    def refuse(words: list[object], *parts: str) -> None:
        output.write_bytes(OLD)
        before = sorted(tmp_path.iterdir())
        refused([*words, "-o", output], *parts)
        assert output.read_bytes() == OLD and sorted(tmp_path.iterdir()) == before, words

    return refuse


# what the line must name: options after `reconstruct SCAN`. Ranges of numbers: tests of the options' own rooms
RECONSTRUCT = {
    "abacus": ("--device abacus",), "--method": ("--method magic",), "--preset": ("--preset best",),
    "--motion": ("--motion wobble", "--method fdk --motion micro-views"), "strips": ("--strips 0",),
    "iterations": ("--iterations -5", "--iterations abc", "--method fdk --iterations 5"), "--seed": ("--seed 1.5",),
    "none.toml": ("--config {tmp}/none.toml",), "/dev/zero": ("--config /dev/zero",), "text.h5": ("--config {text}",),
    "--config": ("--config ''",), "--device": ("--device ''",), "--iteration-count": ("--iteration-count 5",),
    "--detector-model: found no such option of --method fdk": ("--method fdk --detector-model intensity",),
    "--holdout": ("--holdout 60",), "--resume": ("--resume",), "--set": ("--set tv_weight", "--set 'x y=3'"),
    "tv_weight": ("--set tv_weigth=3", "--set tv_weight=much"), "magic": ("--set method=magic",),
    "--size": ("--size a,b,c", "--size 4 --voxel-mm 1 --roi -1,1,-1,1,-1,1"), "--voxel-mm": ("--voxel-mm -1",),
    "--roi-mm": ("--roi 1,-1,-1,1,-1,1", "--roi 90,91,-1,1,-1,1"), "--device: found '99'": ("--device 99",),
}  # fmt: skip
# the same of `simulate --size 8 --detector 8`
SIMULATE = {
    "--phantom": ("--phantom elephant",), "none.h5": ("--volume {tmp}/none.h5",), "r3": ("--scanner r3",),
    "scanner": ("--scanner demo",), "--volume": ("--phantom foot --volume {scan}",),
    "--dose": ("--dose 100", "--noise beer --dose=1o"), "--electronic-noise": ("--electronic-noise 5",),
    "--jitter-deg": ("--protocol static --jitter-deg 0.1",), "pulse": ("--pulse 0.5", "--pulse 0,0"),
    "views": ("--views 1000000000", "--views many", f"--views {'9' * 5000}"), "--device": ("--device ' '",),
    "--size": ("--size 100000", f"--size {DIGITS}"), "--detector": (f"--detector {DIGITS}",),
    "--detector-offset": ("--detector-offset left", "--detector-offset 1,2,3"), "exposure": ("--exposure-deg=1e300",),
    "--readout-ms": ("--readout-ms 62", "--fps 15 --readout-ms 62000"), "--device: found '99'": ("--device 99",),
    "--memory: found 'much'": ("--memory much",),
}  # fmt: skip
OTHERS = {
    "none.h5": ("reconstruct {tmp}/none.h5",), "text.h5": ("reconstruct {text}",),
    "--size": ("import {scan} --size 0",), "SCAN": ("reconstruct '' --method fdk",),
    "--device: found '99'": ("calibrate {scan} --device 99", "check {scan} --fix-offset --device 99"),
}  # fmt: skip


@pytest.mark.parametrize("command", ["reconstruct", "simulate", "others"])
def test_wrong_options(kept, scan, tmp_path, command) -> None:
    (text := tmp_path / "text.h5").write_text("this is [not a table")
    start, table = {
        "reconstruct": (f"reconstruct {scan} --method phyradgs", RECONSTRUCT),
        "simulate": (f"simulate {SMALL}", SIMULATE), "others": ("", OTHERS),
    }[command]  # fmt: skip
    for subject, many in table.items():
        for options in many:
            begun = start.replace(" --method phyradgs", "") if "method" in options else start
            kept(shlex.split(f"{begun} {options}".format(tmp=tmp_path, scan=scan, text=text)), subject)


def test_outputs_that_cannot_be_written(refused, scan, tmp_path) -> None:
    simulate, fdk = ["simulate", *SMALL.split()], ["reconstruct", scan, "--method", "fdk"]
    for output in (tmp_path / "nowhere" / "volume.h5", "/"):
        for words in (fdk, simulate, ["calibrate", scan]):
            line = refused([*words, "-o", output], status=4)
            assert str(output) in line or str(Path(output).parent) in line
    for name in ("v.nii", "v.nii.gz", "V.MHA"):
        refused([*fdk, "-o", tmp_path / name], "another format", f"export volume.h5 -o {name}")
    for words in (simulate, ["reconstruct", "scan.h5"]):
        refused([*words, "-o", ""], "-o: found ''; expected a file name; name a file")
    assert list(tmp_path.iterdir()) == []


def test_inputs_are_never_overwritten(cli, refused, scan, tmp_path) -> None:
    own, config, scanner, volume = (tmp_path / name for name in ("scan.h5", "run.toml", "own.toml", "v.h5"))
    shutil.copy(scan, own)
    config.write_text("method = 'fdk'\n")
    shutil.copy(Path(cli.__file__).parent / "data" / "r2.toml", scanner)
    assert cli.run(["reconstruct", str(scan), "-o", str(volume), "--method", "fdk"]) == 0
    for path, words in (
        (own, ["reconstruct", own, "--method", "fdk", "-o"]), (config, ["reconstruct", scan, "--config", config, "-o"]),
        (scanner, ["simulate", "--scanner", scanner, *SMALL.split(), "-o"]),
        (volume, ["evaluate", volume, "--reference", scan, "--picture"]),
    ):  # fmt: skip
        before = path.read_bytes()
        refused([*words, path])
        assert path.read_bytes() == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_behind_stdout_is_one_line(scan) -> None:
    for words in (["info", str(scan)], []):
        with open("/dev/full", "w") as full:
            command = [sys.executable, "-m", "phyradgs_cl", *words]
            done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
        assert done.returncode == 4
        assert done.stderr.startswith("phyradgs: standard output: ") and done.stderr.count("\n") == 1


RUN = "reconstruct scan.h5 -o volume.h5"
# a word of each kind, and what a user of an earlier version writes
WORDS = {
    "phyradgs splat": ("splat", "splat scan.h5 -o v.h5", "splat --help"), "--method fused": (f"{RUN} --method fused",),
    "--method asd-pocs: option prior_share": (f"{RUN} --method asd-pocs --set prior_share=1",),
    "--what lag": ("calibrate scan.h5 --what lag -o c.h5",), "--preset released": (f"{RUN} --preset released",),
    "tune": (f"{RUN} --tune 3", f"{RUN} --set tune=1"), "scheduler": ("sweep grid.toml -o out --scheduler 3",),
    "readout": ("simulate -o s.h5 --readout 3", "import scan.h5 -o s.h5 --readout 3"),
    "rings.method": (f"{RUN} --set rings.method=1",),
}  # fmt: skip


def test_a_word_that_left_names_its_replacement(refused, scan, tmp_path) -> None:
    """In a file too."""
    for word, lines in WORDS.items():
        for line in lines:
            refused([scan if part == "scan.h5" else part for part in line.split()], f"{REMOVED[word]}\n")
    (tmp_path / "run.toml").write_text("motion = 'static-start'\n")
    refused([*RUN.split(), "--config", tmp_path / "run.toml"], "run.toml: motion", f"{REMOVED['--motion static-start']}\n")
