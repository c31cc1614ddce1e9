"""Commands, options and values that have left: one line says what to write instead."""

import pytest

from phyradgs_cl.removed import REMOVED

pytestmark = pytest.mark.slow
RUN = "reconstruct scan.h5 -o volume.h5"
# a word of each kind, and what a user of an earlier version writes
WORDS = {
    "phyradgs splat": ("splat", "splat scan.h5 -o volume.h5", "splat --help"), "--method fused": (f"{RUN} --method fused",),
    "--method asd-pocs: option prior_share": (f"{RUN} --method asd-pocs --set prior_share=1",),
    "--what lag": ("calibrate scan.h5 --what lag -o c.h5",), "--batch": (f"{RUN} --batch 3",),
    "--motion own-times": (f"{RUN} --motion own-times",), "--preset released": (f"{RUN} --preset released",),
    "tune": (f"{RUN} --tune 3", f"{RUN} --set tune=1"), "scheduler": ("sweep grid.toml -o out --scheduler 3",),
    "readout": ("simulate -o s.h5 --readout 3", "import scan.h5 -o s.h5 --readout 3"),
    "rings.method": (f"{RUN} --set rings.method=1",),
}  # fmt: skip


@pytest.mark.parametrize("word", WORDS)
def test_a_word_that_left_names_its_replacement(cli, scan, capsys, word) -> None:
    for line in WORDS[word]:
        assert cli.run([str(scan) if part == "scan.h5" else part for part in line.split()]) == 2, line
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and error.endswith(f"{REMOVED[word]}\n"), error


def test_a_motion_that_left_is_named_in_a_file_too(cli, capsys, tmp_path) -> None:
    (tmp_path / "run.toml").write_text("motion = 'static-start'\n")
    assert cli.run(["reconstruct", "scan.h5", "-o", "volume.h5", "--config", str(tmp_path / "run.toml")]) == 2
    error = capsys.readouterr().err
    assert "run.toml: motion" in error and error.endswith(f"{REMOVED['--motion static-start']}\n")
