"""phyradgs prepare: a file that says what was done to it, and bad input in one line that loses nothing."""

import json
from pathlib import Path

import numpy as np
import pytest
from damage import changed, on

from phyradgs_cl.io import read_volume
from phyradgs_cl.workflow import load_scan

pytestmark = pytest.mark.slow
SPOILT = (
    "--phantom", "jaw", "--size", "12", "--detector", "20", "--views", "8", "--time-samples", "2",
    "--noise", "beer", "--rings", "0.02", "--sparks", "0.005", "--seed", "3",
)  # fmt: skip
NO_SCATTER = "no scatter found in the light beside the object: the projections stay as they are"


def test_a_clean_file_says_what_was_done_to_it(cli, simulated, tmp_path, capsys) -> None:
    source, output = simulated(*SPOILT), tmp_path / "clean.h5"
    assert cli.run(["prepare", str(source), "-o", str(output), "--json", "--set", "rings.window=5"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])["steps"]
    assert [step["step"] for step in told] == ["sparks", "dead", "rings"] and told[0]["pixels"] > 0
    before, after = load_scan(source), load_scan(output)
    assert after.provenance["prepared"] == told and after.provenance["prepared_from"] == str(source)
    assert (~after.valid).sum() == told[0]["pixels"] + told[1]["pixels"] * after.frames
    assert np.abs(after.projections - before.projections).max() > 0.1
    for name in ("reference", "frame_start_s"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    volume, steps = tmp_path / "v.h5", ["--steps", "sparks,dead,rings", "--set", "rings.window=5"]
    assert cli.run(["reconstruct", str(source), "-o", str(volume), "--method", "fdk", *steps]) == 0
    direct = read_volume(volume)
    assert cli.run(["reconstruct", str(output), "-o", str(volume), "--method", "fdk"]) == 0
    np.testing.assert_allclose(direct.values, read_volume(volume).values, atol=1e-6)
    assert [step["step"] for step in direct.provenance["prepared"]] == ["sparks", "dead", "rings"]


WEAK = ("--phantom", "foot", "--size", "24", "--detector", "32", "--views", "60", "--protocol", "static", "--scatter", "0.3")


# no scatter, and scatter of an object so weak that little of it reaches the light beside it
@pytest.mark.parametrize("words", [(*SPOILT[:-6], "--noise", "none"), WEAK])
def test_a_step_that_finds_nothing_says_so_and_may_be_asked_again(cli, simulated, tmp_path, capsys, words) -> None:
    source, clean = simulated(*words), tmp_path / "clean.h5"
    assert cli.run(["prepare", str(source), "-o", str(clean), "--steps", "scatter"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("scatter")]
    assert line.split(maxsplit=1)[1] == NO_SCATTER
    np.testing.assert_array_equal(load_scan(clean).projections, load_scan(source).projections)
    stated = ["prepare", clean, "-o", tmp_path / "again.h5", "--steps", "scatter", "--set", "scatter.to_primary=0.2"]
    if words is WEAK:
        assert cli.run(list(map(str, stated))) == 2
        assert "scatter.to_primary=0.2: found 0.2; expected a ratio that the kernel gives" in capsys.readouterr().err
    else:
        assert cli.run(list(map(str, stated))) == 0 and "to primary 0.2" in capsys.readouterr().out


def test_a_configuration_file_says_the_same(cli, simulated, tmp_path, capsys) -> None:
    config, clean, cleaner = (str(tmp_path / name) for name in ("steps.toml", "clean.h5", "cleaner.h5"))
    Path(config).write_text('steps = "rings"\n[rings]\nwindow = 5\n')
    assert cli.run(["prepare", str(simulated(*SPOILT)), "-o", clean, "--config", config, "--json"]) == 0
    (step,) = json.loads(capsys.readouterr().out.splitlines()[-1])["steps"]
    assert step["options"] == {"window": 5}
    assert cli.run(["prepare", clean, "-o", cleaner, "--steps", "dead"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines] == ["done before", "dead", cleaner]
    assert lines[0].split()[2:] == ["rings"]


def test_bad_input_is_one_line_and_loses_nothing(refused, simulated, tmp_path) -> None:
    source, output = simulated(*SPOILT), tmp_path / "clean.h5"
    output.write_bytes(b"what was there before")
    (flooded := tmp_path / "flooded.h5").write_bytes(Path(source).read_bytes())
    on("entry/instrument/detector/data", changed(lambda data: data + 2))(flooded)
    for words, parts in (
        (["--steps", "ring"], ("--steps", "did you mean 'rings'")), (["--steps", ""], ("--steps", "found none")),
        (["--set", "scatter.reach=0.1"], ("--set scatter.reach=0.1", "scatter among the steps")),
        (["--steps", "rings", "--set", "rings.windows=3"], ("rings.windows", "did you mean 'window'")),
        (["--set", "flats=time"], ("flats=time", "attenuation with 0 flats", "flats=mean")),
        (["-o", source], ("-o", "reads or writes")),
    ):  # fmt: skip
        refused(["prepare", source, "-o", output, *words], *parts)
    for step, part in (("air", "pixels of air"), ("scatter", "state scatter.to_primary"), ("hardening", "hardening")):
        refused(["prepare", flooded, "-o", output, "--steps", step], f"--steps {step}", part)
    assert output.read_bytes() == b"what was there before"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clean.h5", "flooded.h5"]
