"""phyradgs export, as the command line runs it."""

import re
import shlex
from pathlib import Path

import numpy as np
import pydicom
import pytest
import typer
from typer.testing import CliRunner

from phyradgs_cl.commands.files import EXAMPLES, export_command
from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters import EXPORTS
from phyradgs_cl.fields import Deformation
from phyradgs_cl.io import write_deformation

pytestmark = pytest.mark.slow


@pytest.fixture
def run():
    (app := typer.Typer(rich_markup_mode=None)).command("export", epilog=EXAMPLES["export"])(export_command)
    return lambda *arguments: CliRunner().invoke(app, [str(a) for a in arguments])


def test_the_output_s_suffix_says_the_format(run, volume_file, tmp_path) -> None:
    """An unknown one lists those that are known."""
    for name in ("a.nii.gz", "a.TIF", "a.mha", "a.ply"):
        done = run(volume_file, "-o", tmp_path / name)
        assert done.exit_code == 0 and (tmp_path / name).exists(), done.exception
    for output in (("-o", "a.stl"), ("-o", "folder"), ()):
        error = run(volume_file, *output).exception
        assert isinstance(error, InputError) and ".nii, .nii.gz, .mha, .nrrd, .tif, .tiff, .npy, .ply, .npz" in str(error)
    done = run(volume_file, "--to", "nii", "-o", tmp_path / "hu.nii.gz", "--mu-water-per-mm", "0.02")
    assert done.exit_code == 0 and "HU" in done.output and (tmp_path / "hu.nii.gz").exists()


def test_a_series_says_whose_it_is(run, volume_file, tmp_path) -> None:
    """As pydicom reads it; without a word of it nothing is claimed. Another patient's is another study."""
    labels = {"patient": "Müller^Änne", "title": "Foot, fly-scan", "description": "fista", "date": "2026-03-31"}
    words = [word for name, value in labels.items() for word in (f"--{name}", value)]
    assert run(volume_file, "--to", "dicom", "-o", tmp_path / "plain").exit_code == 0
    assert run(volume_file, "--to", "dicom", "-o", tmp_path / "named", *words).exit_code == 0
    plain, named = (pydicom.dcmread(tmp_path / folder / "0001.dcm") for folder in ("plain", "named"))
    assert named.PatientName.family_name == "Müller" and named.PatientName == named.PatientID == labels["patient"]
    assert (named.StudyDescription, named.SeriesDescription, named.StudyDate) == ("Foot, fly-scan", "fista", "20260331")
    assert named.ImageComments == plain.ImageComments == plain.SeriesDescription == "values in 1/mm"
    assert not plain.StudyDate and not plain.PatientID and "StudyDescription" not in plain
    assert named.StudyInstanceUID != plain.StudyInstanceUID and named.SOPInstanceUID != plain.SOPInstanceUID
    for name, value in labels.items():
        with pytest.raises(InputError, match=f"^--{name}: given with --to nii; expected --to dicom"):
            raise run(volume_file, "--to", "nii", f"--{name}", value).exception
    for name, value in {"patient": "x" * 65, "title": "a\\b", "description": "two\nlines", "date": "31.3.2026"}.items():
        with pytest.raises(InputError, match=f"^--{name}: found"):
            raise run(volume_file, "--to", "dicom", "-o", tmp_path / "wrong", f"--{name}", value).exception
    assert not (tmp_path / "wrong").exists() and not volume_file.with_suffix(".nii").exists()


DOCS = Path(__file__).resolve().parents[2] / "docs" / "export.md"


def test_the_documentation_s_examples_run(run, volume_file, monkeypatch) -> None:
    text = DOCS.read_text(encoding="utf-8")
    assert not [to for to in EXPORTS if f"| `{to}` |" not in text]
    monkeypatch.chdir(volume_file.parent)
    field = Deformation(np.ones((1, 2, 2, 2, 3)), (10.0, -4.0, 3.0), 5.0, np.array([0.0, 9.0]), np.array([[0.0], [1.0]]))
    write_deformation(Path("field.h5"), field)
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(compile(block, str(DOCS), "exec"), {})
    for line in re.findall(r"^phyradgs export (.*)$", text, re.M):
        assert run(*shlex.split(line)).exit_code == 0
    assert {"volume.nii", "volume.nii.gz", "volume.ply"} <= {path.name for path in volume_file.parent.iterdir()}
