"""Damaged and hostile files: one InputError of one line, in seconds, and nothing executed, followed or filled up."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import hostile_of_importers as hostile
import numpy as np
import pytest
import writers_of_importers as w

from phyradgs_cl.acquisition import ConeGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan

CONE = ImportOptions(source_to_axis_mm=500.0, source_to_detector_mm=800.0)
REAL = ImportOptions(pixel_size_mm=(3.0, 2.5))
NONE = ImportOptions()
# format: (what writes a good one, its name, options, cases)
FORMS: dict[str, tuple[Callable[..., Path], str, ImportOptions, dict[str, Any]]] = {
    "r2": (w.write_r2, "r2", NONE, hostile.R2),
    "phyradgs": (w.write_phyradgs, "phyradgs", NONE, hostile.PHYRADGS),
    "phyradgs-real": (w.write_phyradgs_real, "real", REAL, hostile.REAL),
    "naf": (w.write_naf, "chest.pickle", NONE, hostile.NAF),
    "rtk": (w.write_rtk, "rtk", NONE, hostile.RTK),
    "data-exchange": (w.write_data_exchange, "dx.h5", CONE, hostile.EXCHANGE),
    "nxtomo": (w.write_nxtomo, "nx.h5", NONE, hostile.NXTOMO),
    "tiff": (w.write_tiff, "tiff", NONE, hostile.TIFF),
}
CASES = [(form, case) for form, (_, _, _, cases) in FORMS.items() for case in cases]
HARMLESS = {("tiff", "pages in a circle")}  # may be read, once, as well as refused
SECONDS, MEGABYTES = 15.0 * (4 if sys.gettrace() else 1), 150  # lines that are counted take longer


def centred(form: str, make_truth: Callable[..., Any]) -> ConeGeometry:
    """The writer of real views has source and panel face each other."""
    geometry = make_truth().scan.geometry
    return replace(geometry, detector_offset_mm=(4.0, 0.0)) if form == "phyradgs-real" else geometry


@pytest.mark.parametrize(("form", "case"), CASES, ids=[f"{form}: {case}" for form, case in CASES])
def test_refused(tmp_path, make_truth, monkeypatch, form, case) -> None:
    write, name, options, cases = FORMS[form]
    damage, words = cases[case]
    flying = form.startswith("phyradgs")
    (tmp_path / "in").mkdir()
    path = write(tmp_path / "in" / name, make_truth(fly=flying, geometry=centred(form, make_truth)))
    damage(path)
    monkeypatch.chdir(tmp_path)
    began_s = time.process_time()
    tracemalloc.start()
    try:
        scan = import_scan(path, options, form)
    except InputError as error:
        text = str(error)
        assert "\n" not in text and len(text) < 1500
        for word in words:
            assert word in text, text
    else:
        assert (form, case) in HARMLESS, f"imported {scan.frames} frames"
    finally:
        _, peak_bytes = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert time.process_time() - began_s < SECONDS
    assert peak_bytes / 2**20 < MEGABYTES
    assert not list(tmp_path.rglob("canary")), "something was executed"


def test_good_files_pass_where_damaged_ones_do_not(tmp_path, make_truth) -> None:
    """The cases above would prove nothing if the files were refused before they were damaged."""
    for form, (write, name, options, _) in FORMS.items():
        truth = make_truth(fly=form.startswith("phyradgs"), geometry=centred(form, make_truth))
        path = write(tmp_path / name, truth)
        assert import_scan(path, options, form).frames > 0


def test_a_deflated_stack_is_unpacked_no_further_than_it_says(tmp_path, make_truth) -> None:
    path = w.write_rtk(tmp_path / "rtk", make_truth())
    header = (path / hostile.MHA).read_bytes().split(b"LOCAL\n")[0].replace(b"Data = False", b"Data = True")
    (path / hostile.MHA).write_bytes(header + b"LOCAL\n" + hostile.deflated_zeros(300))
    tracemalloc.start()
    try:
        assert not import_scan(path).projections.any()
        assert tracemalloc.get_traced_memory()[1] / 2**20 < 20
    finally:
        tracemalloc.stop()


def test_a_deflated_image_larger_than_this_machine_s_share_is_refused(tmp_path, make_truth, monkeypatch) -> None:
    """2 MB that inflate to 2 GB, in small: what the header promises counts, and nothing is unpacked."""
    path = w.write_tiff(tmp_path / "tiff", make_truth())
    hostile.tifffile.imwrite(path / "proj_all.tif", np.zeros((6, 1000, 1000), np.float32), compression="zlib")
    hostile.in_text(hostile.TOML, "proj_*", "proj_all")(path)
    monkeypatch.setattr("phyradgs_cl.importers.reading.bounded.host_bytes", lambda: 50e6)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"proj_all.tif: found 0.0503 GiB to unpack; expected at most 0.0373 GiB"):
            import_scan(path)
        assert tracemalloc.get_traced_memory()[1] / 2**20 < 2
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("dtype", "compression"), [(np.float32, None), (np.float32, "zlib"), (np.uint16, None)])
def test_a_good_stack_takes_twice_its_line_integrals(tmp_path, make_truth, dtype, compression) -> None:
    """The frames as stored and their line integrals, one byte per pixel for the mask, and blocks."""
    path = w.write_tiff(tmp_path / "tiff", make_truth(), angles="step_deg = 10")
    frames = np.random.default_rng(0).integers(1000, 50000, (32, 400, 400)).astype(dtype)
    for name, stack in (("proj", frames), ("flat", frames[:2]), ("dark", frames[:1] * 0)):
        hostile.tifffile.imwrite(
            path / f"{name}_all.tif", stack, compression=compression, photometric="minisblack"
        )
        hostile.in_text(hostile.TOML, f"{name}_*", f"{name}_all")(path)
    tracemalloc.start()
    try:
        scan = import_scan(path)
        assert tracemalloc.get_traced_memory()[1] < 2.5 * scan.projections.nbytes + 16e6
    finally:
        tracemalloc.stop()


def test_a_hole_among_the_frames_of_a_json_of_several_scans_is_refused(tmp_path, make_truth) -> None:
    """Each frame takes the view of its place from the first one on."""
    truth = make_truth(fly=True, geometry=centred("phyradgs-real", make_truth))
    path = w.write_phyradgs_real(tmp_path / "real", truth)
    (path / "projections" / "2.tif").unlink()
    with pytest.raises(InputError, match=r"3.tif after 1.tif: a hole"):
        import_scan(path, replace(REAL, first_view=0))


UNKNOWN = {
    "nothing": lambda p: None,
    "an empty folder": lambda p: p.mkdir(),
    "some text": lambda p: p.write_text("hello"),
    "a folder of text": lambda p: (p.mkdir(), (p / "a.txt").write_text("hello")),
    "two formats": lambda p: (p.mkdir(), [(p / f"a.{s}").write_text("") for s in ("xml", "mha", "toml")]),
}


@pytest.mark.parametrize("case", UNKNOWN)
def test_what_is_not_recognised_is_said(tmp_path, case) -> None:
    UNKNOWN[case](tmp_path / "what")
    with pytest.raises(InputError, match="what: found"):
        import_scan(tmp_path / "what")


@pytest.mark.parametrize("form", FORMS)
def test_what_is_not_there_is_not_looked_for_elsewhere(tmp_path, make_truth, form) -> None:
    """A good scan beside a name that does not exist must not be taken instead; nor is a pipe ever opened."""
    write, name, options, _ = FORMS[form]
    truth = make_truth(fly=form.startswith("phyradgs"), geometry=centred(form, make_truth))
    path = write(tmp_path / name, truth)
    folder = path if path.is_dir() else tmp_path
    with pytest.raises(InputError, match="nothing there"):
        import_scan(folder / "missing.xml", options, form)
    if not hasattr(os, "mkfifo"):
        return
    os.mkfifo(folder / "pipe")
    with pytest.raises(InputError, match="neither a file nor a folder"):
        import_scan(folder / "pipe", options, form)


def test_a_file_that_crashes_the_hdf5_library_does_not_end_this_process() -> None:
    """A few bytes changed in an NXtomo file: the library follows an attribute into nowhere."""
    path = Path(__file__).with_name("data") / "crashes_hdf5.h5"
    program = (
        "from contextlib import suppress; from phyradgs_cl.errors import InputError;"
        "from phyradgs_cl.importers import import_scan\n"
        "with suppress(InputError):\n"  # a later library may even read it
        f"    import_scan({str(path)!r}, form='nxtomo')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_description_under_another_name(tmp_path, make_truth) -> None:
    path = w.write_r2(tmp_path / "r2", make_truth())
    text = (path / "meta_data.json").read_text().replace('"DSO": 500.0', '"DSO": 400.0')
    (path / "other.json").write_text(text)
    assert import_scan(path / "other.json", form="r2").geometry.source_to_axis_mm == 400


def test_an_option_that_the_format_has_no_use_for_is_refused(tmp_path, make_truth) -> None:
    path = w.write_r2(tmp_path / "r2", make_truth())
    with pytest.raises(InputError, match="--rotates with format r2"):
        import_scan(path, ImportOptions(rotates="sample"))


OPTIONS = {
    "exposure_s": -1.0,
    "readout_s": float("nan"),
    "frame_time_s": 0.0,
    "angle_at": "end",
    "readout_axis": "diagonal",
    "readout_direction": 2,
    "source_to_axis_mm": -5.0,
    "pixel_size_mm": (1.0, 0.0),
    "detector_offset_mm": (float("inf"), 0.0),
    "unit_mm": 0.0,
    "rotates": "both",
    "row_0": "left",
    "quantity": "hounsfield",
    "flat_value": 0.0,
    "part": "half",
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options_are_checked(name) -> None:
    with pytest.raises(InputError, match="^--"):
        ImportOptions(**{name: OPTIONS[name]})


def test_a_link_given_by_the_user_is_followed(tmp_path, make_truth) -> None:
    """What the user names is the user's business; what a file names is not."""
    path = w.write_r2(tmp_path / "r2", make_truth())
    (tmp_path / "link").symlink_to(path)
    assert import_scan(tmp_path / "link").frames == 4


def test_a_second_copy_of_a_simulation_is_found_under_the_first_name(tmp_path, make_truth) -> None:
    path = w.write_r2(tmp_path / "r2", make_truth())
    meta = json.loads((path / "meta_data.json").read_text())
    for entry in meta["proj_train"]:
        entry["file_path"] = entry["file_path"].replace(".npy", "_sim1.npy")
    (path / "meta_data.json").write_text(json.dumps(meta))
    scan = import_scan(path)
    np.testing.assert_array_equal(scan.projections, make_truth().scan.projections[:4])
