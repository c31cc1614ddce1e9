"""Damaged and hostile files: one InputError of one line, in seconds, and nothing executed, followed or filled up."""

import json
import os
import random
import sys
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import hostile_of_importers as hostile
import numpy as np
import pytest
import writers_of_importers as w

from phyradgs_cl.errors import InputError, PhyradgsError
from phyradgs_cl.importers import ImportOptions, import_scan
from phyradgs_cl.io import load_scanner
from phyradgs_cl.settings import read_config

CONE = ImportOptions(source_to_axis_mm=500.0, source_to_detector_mm=800.0)
REAL = ImportOptions(pixel_size_mm=(3.0, 2.5))
OPTIONS = {"phyradgs-real": REAL, "data-exchange": CONE}
FORMS: dict[str, dict[str, Any]] = {
    "r2": hostile.R2, "phyradgs": hostile.PHYRADGS, "phyradgs-real": hostile.REAL, "naf": hostile.NAF,
    "rtk": hostile.RTK, "data-exchange": hostile.EXCHANGE, "nxtomo": hostile.NXTOMO, "tiff": hostile.TIFF,
    "nikon": hostile.NIKON, "zeiss": hostile.ZEISS, "skyscan": hostile.SKYSCAN, "flexray": hostile.FLEXRAY,
    "leap": hostile.LEAP, "tigre": hostile.TIGRE,
}  # fmt: skip
CASES = [(form, case) for form, cases in FORMS.items() for case in cases]
HARMLESS = {("tiff", "pages in a circle")}  # may be read, once, as well as refused
SECONDS, PEAK_BYTES = 15.0 * (4 if sys.gettrace() else 1), 150 << 20  # lines that are counted take longer


@contextmanager
def at_most(peak_bytes: float) -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < peak_bytes
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("form", "case"), CASES, ids=[f"{form}: {case}" for form, case in CASES])
def test_refused(tmp_path, make_truth, monkeypatch, form, case) -> None:
    damage, words = FORMS[form][case]
    (tmp_path / "in").mkdir()
    path = w.write(form, tmp_path / "in", make_truth)
    damage(path)
    monkeypatch.chdir(tmp_path)
    began_s = time.process_time()
    with at_most(PEAK_BYTES):
        try:
            scan = import_scan(path, OPTIONS.get(form), form)
        except InputError as error:
            text = str(error)
            assert "\n" not in text and len(text) < 1500
            assert all(word in text for word in words), text
        else:
            assert (form, case) in HARMLESS, f"imported {scan.frames} frames"
    assert time.process_time() - began_s < SECONDS
    assert not list(tmp_path.rglob("canary")), "something was executed"


@pytest.mark.parametrize("form", FORMS)
def test_good_files_pass_and_what_is_not_there_is_not_looked_for_elsewhere(
    tmp_path, make_truth, form
) -> None:
    """The cases above would prove nothing if files were refused before they were damaged; no pipe is ever opened."""
    path, options = w.write(form, tmp_path, make_truth), OPTIONS.get(form)
    assert import_scan(path, options, form).frames > 0
    folder = path if path.is_dir() else tmp_path
    with pytest.raises(InputError, match="nothing there"):
        import_scan(folder / "missing.xml", options, form)
    if hasattr(os, "mkfifo"):
        os.mkfifo(folder / "pipe")
        with pytest.raises(InputError, match="neither a file nor a folder"):
            import_scan(folder / "pipe", options, form)


def test_a_deflated_image_larger_than_this_machine_s_share_is_refused(tmp_path, make_truth, monkeypatch) -> None:
    """2 MB that inflate to 2 GB, in small: what the header promises counts, and nothing is unpacked."""
    path = w.write_tiff(tmp_path / "tiff", make_truth())
    hostile.tifffile.imwrite(path / "proj_all.tif", np.zeros((6, 1000, 1000), np.float32), compression="zlib")
    hostile.in_text(hostile.TOML, "proj_*", "proj_all")(path)
    monkeypatch.setattr("phyradgs_cl.importers.reading.files.host_bytes", lambda: 50e6)
    said = r"proj_all.tif: found 0.0503 GiB to unpack; expected at most 0.0373 GiB"
    with at_most(2e6), pytest.raises(InputError, match=said):
        import_scan(path)


@pytest.mark.parametrize(("dtype", "compression"), [(np.float32, None), (np.float32, "zlib"), (np.uint16, None)])
def test_a_good_stack_takes_twice_its_line_integrals(tmp_path, make_truth, dtype, compression) -> None:
    """The frames as stored and their line integrals, one byte per pixel for the mask, and blocks."""
    path = w.write_tiff(tmp_path / "tiff", make_truth(), angles="step_deg = 10")
    frames = np.random.default_rng(0).integers(1000, 50000, (32, 250, 250)).astype(dtype)
    for name, stack in (("proj", frames), ("flat", frames[:2]), ("dark", frames[:1] * 0)):
        options = {"compression": compression, "photometric": "minisblack"}
        hostile.tifffile.imwrite(path / f"{name}_all.tif", stack, **options)
        hostile.in_text(hostile.TOML, f"{name}_*", f"{name}_all")(path)
    with at_most(2.5 * 4 * frames.size + 8e6):
        import_scan(path)


def test_frames_by_name(tmp_path, make_truth) -> None:
    """Each frame takes the view of its place from the first one on."""
    path = w.write("phyradgs-real", tmp_path, make_truth)
    (path / "projections" / "2.tif").unlink()
    with pytest.raises(InputError, match=r"3.tif after 1.tif: a hole"):
        import_scan(path, replace(REAL, first_view=0))
    path = w.write_r2(tmp_path / "r2", make_truth())
    meta = json.loads((path / "meta_data.json").read_text())
    for entry in meta["proj_train"]:
        entry["file_path"] = entry["file_path"].replace(".npy", "_sim1.npy")
    (path / "meta_data.json").write_text(json.dumps(meta))
    scan = import_scan(path)
    np.testing.assert_array_equal(scan.projections, make_truth().scan.projections[:4])


UNKNOWN = {
    "nothing": lambda p: None, "an empty folder": lambda p: p.mkdir(),
    "some text": lambda p: p.write_text("hello"),
    "a folder of text": lambda p: (p.mkdir(), (p / "a.txt").write_text("hello")),
    "two formats": lambda p: (p.mkdir(), [(p / f"a.{s}").write_text("") for s in ("xml", "mha", "toml")]),
}


def test_what_is_not_recognised_is_said(tmp_path) -> None:
    for case, make in UNKNOWN.items():
        (tmp_path / case).mkdir()
        make(tmp_path / case / "what")
        with pytest.raises(InputError, match="what: found"):
            import_scan(tmp_path / case / "what")


def test_notes_and_logs_that_are_links_or_folders_do_not_matter(tmp_path, make_truth) -> None:
    """Files that any folder may have, and that some formats describe their scans with."""
    path = w.write_tiff(tmp_path / "tiff", make_truth())
    (path / "notes.txt").symlink_to(tmp_path / "nowhere")
    (path / "run.log").mkdir()
    assert import_scan(path).frames == 6


def test_what_the_user_names_is_the_user_s_business(tmp_path, make_truth) -> None:
    """A link, unlike one that a file names; a description under another name; an option without use."""
    path = w.write_r2(tmp_path / "r2", make_truth())
    (tmp_path / "link").symlink_to(path)
    assert import_scan(tmp_path / "link").frames == 4
    text = (path / "meta_data.json").read_text().replace('"DSO": 500.0', '"DSO": 400.0')
    (path / "other.json").write_text(text)
    assert import_scan(path / "other.json", form="r2").geometry.source_to_axis_mm == 400
    (path / "other.json").unlink()
    with pytest.raises(InputError, match="^rotates with format r2"):
        import_scan(path, ImportOptions(rotates="sample"))


def test_options_are_checked() -> None:
    for name, value in [
        ("exposure_s", -1.0), ("readout_s", float("nan")), ("frame_time_s", 0.0), ("angle_at", "end"),
        ("part", "half"),
        ("readout_axis", "diagonal"), ("readout_direction", 2), ("source_to_axis_mm", -5.0), ("unit_mm", 0.0),
        ("pixel_size_mm", (1.0, 0.0)), ("detector_offset_mm", (float("inf"), 0.0)), ("rotates", "both"),
        ("row_0", "left"), ("quantity", "hounsfield"), ("flat_value", 0.0),
    ]:  # fmt: skip
        with pytest.raises(InputError, match=f"^{name}: "):
            ImportOptions(**{name: value})


# what a byte is changed in: the format and the file of its folder, or a reader of a description in TOML
FUZZED = [
    ("r2", "meta_data.json"), ("r2", "proj_train/0000.npy"), ("phyradgs-real", hostile.GEO), ("rtk", hostile.XML),
    ("rtk", hostile.MHA), ("tiff", "proj_1.tif"), ("tiff", hostile.TOML), ("naf", ""), ("scanner", ""),
    ("nikon", hostile.XTEK), ("skyscan", hostile.LOG), ("flexray", hostile.SETTINGS), ("zeiss", ""),
    ("leap", hostile.PARAMS), ("tigre", ""),
    ("configuration", ""),
]  # fmt: skip
CONFIG = "method = 'phyradgs'\nstrips = 2\ntv_weight = 0.02\n[rates]\nposition = [2e-4, 2e-5]\n[control]\nevery = 100\n"
CHANGES = 40 * int(os.environ.get("STRESS", "1"))  # `make stress` sets STRESS


@pytest.mark.filterwarnings("ignore")  # of NumPy about casts of absurd numbers
@pytest.mark.parametrize(("form", "name"), FUZZED)
def test_changed_bytes_are_a_value_or_one_error(tmp_path, make_truth, form, name) -> None:
    """HDF5 files are left out: the library itself crashes on some damaged headers."""
    file = path = tmp_path / "described.toml"
    if form == "scanner":
        path.write_bytes((Path(__file__).parents[2] / "data" / "carm.toml").read_bytes())
        read = partial(load_scanner, path, Path("/nowhere"))
    elif form == "configuration":
        path.write_text(CONFIG)
        read = partial(read_config, path)
    else:
        path = w.write(form, tmp_path, make_truth)
        file, read = path / name if name else path, partial(import_scan, path, OPTIONS.get(form), form)
    read()
    content, draw = file.read_bytes(), random.Random(form + name)
    for _ in range(CHANGES):
        new = bytearray(content)
        for _ in range(draw.randint(1, 6)):
            at = draw.randrange(min(len(new), draw.choice((2048, len(new)))))
            pieces = (b"", draw.randbytes(2), b"\xff" * 8, b"nan", b"1e400", b"9" * 30)
            new[at : at + draw.randint(0, 2)] = draw.choice(pieces)
        file.write_bytes(new)
        try:
            read()
        except PhyradgsError as error:
            assert "\n" not in str(error) and error.exit_code in (2, 6), new
