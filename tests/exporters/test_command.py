"""phyradgs export, as the command line runs it."""

import re
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from phyradgs_cl.api import save_scan, simulate
from phyradgs_cl.commands.export_volume import EXAMPLE, export_command
from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters import EXPORTS


@pytest.fixture
def run():
    app = typer.Typer(rich_markup_mode=None)
    app.command("export", epilog=EXAMPLE)(export_command)
    return lambda *arguments: CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.mark.parametrize("to", EXPORTS)
def test_every_format(run, volume_file, to) -> None:
    done = run(volume_file, "--to", to)
    assert done.exit_code == 0, done.output
    assert to in done.output and done.output.count("\n") == 1
    assert len(list(volume_file.parent.iterdir())) >= 2


def test_the_output_s_suffix_says_the_format(run, volume_file, tmp_path) -> None:
    """An unknown one lists those that are known."""
    for name in ("a.nii.gz", "a.TIF", "a.mha", "a.ply"):
        done = run(volume_file, "-o", tmp_path / name)
        assert done.exit_code == 0 and (tmp_path / name).exists(), done.exception
    for output in (("-o", "a.stl"), ("-o", "folder"), ()):
        error = run(volume_file, *output).exception
        assert isinstance(error, InputError)
        assert ".nii, .nii.gz, .mha, .nrrd, .tif, .tiff, .npy, .ply, .npz" in str(error)
    done = run(volume_file, "--to", "nii", "-o", tmp_path / "hu.nii.gz", "--mu-water-per-mm", "0.02")
    assert done.exit_code == 0 and "HU" in done.output and (tmp_path / "hu.nii.gz").exists()


def test_wrong_input_is_our_error(run, rt, tmp_path) -> None:
    assert isinstance(run(tmp_path / "none.h5", "--to", "nii").exception, InputError)
    assert run(tmp_path / "none.h5", "--to", "obj").exit_code == 2
    save_scan(tmp_path / "scan.h5", simulate("foot", size=8, detector=8, views=3, noise="none", device=rt))
    with pytest.raises(InputError, match="found a scan.*expected a volume"):
        raise run(tmp_path / "scan.h5", "--to", "nii").exception


DOCS = Path(__file__).resolve().parents[2] / "docs" / "export.md"


def test_the_documentation_s_examples_run(run, volume_file, monkeypatch) -> None:
    text = DOCS.read_text(encoding="utf-8")
    assert not [to for to in EXPORTS if f"| `{to}` |" not in text]
    monkeypatch.chdir(volume_file.parent)
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(compile(block, str(DOCS), "exec"), {})
    for line in re.findall(r"^phyradgs export (.*)$", text, re.M):
        assert run(*line.split()).exit_code == 0
    found = {path.name for path in volume_file.parent.iterdir()}
    assert {"volume.nii", "volume.nii.gz", "volume.ply"} <= found
