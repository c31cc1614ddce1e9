"""A scan in every foreign format, imported, is the scan itself: pixels, geometry, timing, grid and truth."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import writers_of_importers as w
from damage import changed, on

from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan, recognise

pytestmark = pytest.mark.slow
FLY = ImportOptions(0.4, 0.3, 1.25, readout_axis="columns", readout_direction=-1)
MOVING = {"fly": True, "axis": "columns", "direction": -1}
ALL = ImportOptions(part="all")
CONE = {"source_to_axis_mm": 500.0, "source_to_detector_mm": 800.0, "detector_offset_mm": (4.0, -6.0)}
TIMED = "[timing]\nexposure_s = 0.4\nreadout_s = 0.3\n{}\n[readout]\naxis = 'columns'\ndirection = -1\n"
EVERY = TIMED.format("frame_time_s = 1.25")
ROWS = ImportOptions(exposure_s=0.4, readout_axis="rows")
STARTS, STEPS = "start_s = [0, 1.25, 2.5, 3.75, 5, 6.25]", "first_deg = 10.0\nstep_deg = 25.0"
MIDDLE = "first_deg = 14.0\nlast_deg = 139.0\nat = 'middle'"  # 25 · 0.5 · 0.4 / 1.25 after the opening
# (format, what its writer is told, how the scan moves, options): grids are stored by some formats only
SAME = {
    "r2, scene units": ("r2", {"unit_mm": 40.0}, {}, replace(ALL, unit_mm=40.0)),
    "r2, moving": ("r2", {}, MOVING, replace(FLY, part="all")),
    # the first stored line is read first: the left column, or the top row, which is our last
    "phyradgs by columns": ("phyradgs", {}, MOVING | {"direction": 1}, ImportOptions(exposure_s=0.4)),
    "phyradgs by rows": ("phyradgs", {}, MOVING | {"axis": "rows"}, ROWS),
    **{f"naf in {dtype}": ("naf", {"dtype": np.dtype(dtype)}, {}, ALL) for dtype in ("f8", ">f4")},
    **{f"naf, protocol {one}": ("naf", {"protocol": one, "numbers": one == 3}, {}, ALL) for one in range(6)},
    "rtk flipped and packed": ("rtk", {"flip": True, "compressed": True}, {}, None),
    "rtk": ("rtk", {}, {}, None),
    "rtk with a header of its own": ("rtk", {"flip": True, "name": "projections.mhd"}, {}, None),
    "rtk, moving": ("rtk", {}, MOVING, FLY),
    "data-exchange, moving": ("data-exchange", {}, MOVING, replace(FLY, **CONE)),
    "nxtomo, moving": ("nxtomo", {}, MOVING, replace(FLY, exposure_s=None, detector_offset_mm=(4.0, -6.0))),
    "tiff, frame time": ("tiff", {"timing": EVERY, "angles": STEPS}, MOVING, None),
    "tiff, starts": ("tiff", {"timing": TIMED.format(STARTS), "angles": STEPS}, MOVING, None),
    "tiff, middles": ("tiff", {"timing": EVERY, "angles": MIDDLE}, MOVING, None),
}  # fmt: skip
SAID = ": a parallel beam"
OFFSET = {"detector_offset_mm": (4.0, -6.0)}
PARALLEL = {
    "r2": ("r2", {}, {}, ALL), "naf": ("naf", {}, {}, ALL), "phyradgs": ("phyradgs", {}, MOVING | {"axis": "rows"}, ROWS),
    "data-exchange": ("data-exchange", {}, {}, ImportOptions(**OFFSET)),
    "data-exchange, moving": ("data-exchange", {}, MOVING, replace(FLY, **OFFSET)),
    "nxtomo": ("nxtomo", {}, {}, ImportOptions(row_0="bottom")),
    "rtk": ("rtk", {}, {}, None), "rtk, moving": ("rtk", {}, MOVING, FLY), "tiff, moving": ("tiff", {}, MOVING, FLY),
}  # fmt: skip


def test_distances_make_a_cone_of_a_file_that_states_none(tmp_path, make_truth, caplog) -> None:
    """Microfocus scanners too write files without distances; one that says parallel stays so."""
    truth = make_truth(geometry=ParallelGeometry((10, 14), (3.0, 2.5)))
    for form in ("data-exchange", "nxtomo"):
        path = w.write(form, tmp_path, lambda **_: truth)
        scan = import_scan(path, ImportOptions(source_to_axis_mm=500.0, source_to_detector_mm=800.0))
        assert scan.geometry == ConeGeometry(500.0, 800.0, (10, 14), (3.0, 2.5)) and SAID not in caplog.text
        with pytest.raises(InputError, match="source_to_axis_mm"):
            import_scan(path, ImportOptions(source_to_detector_mm=800.0))
    path = w.write("tiff", tmp_path, lambda **_: truth)
    with pytest.raises(InputError, match="^source_to_detector_mm: found 800; expected no distance: .* parallel beam"):
        import_scan(path, ImportOptions(source_to_detector_mm=800.0))
    with h5py.File(tmp_path / "dx.h5", "r+") as file:
        file["measurement/instrument/source/distance"] = 0.0
    with pytest.raises(InputError, match="source/distance: found 0"):
        import_scan(tmp_path / "dx.h5")


@pytest.mark.parametrize(("case", "is_parallel"), [*((case, False) for case in SAME), *((case, True) for case in PARALLEL)])
def test_the_same_scan(tmp_path, make_truth, assert_same, caplog, case, is_parallel) -> None:
    """Of a parallel beam an axis off the panel's middle, in mm or in the columns of nxtomo, is the detector's offset, and a
    line says so where no distance is stated."""
    form, how, motion, options = (PARALLEL if is_parallel else SAME)[case]
    flat = {"geometry": ParallelGeometry((10, 14), (3.0, 2.5), (0.0 if form == "nxtomo" else 4.0, -6.0))}
    truth = make_truth(**motion, **(flat if is_parallel else {}))
    writer, name = w.WRITERS[form]
    path = writer(tmp_path / name, truth, **how)
    assert recognise(path) == form
    assert_same(import_scan(path, options), truth, grid=form in ("r2", "phyradgs", "naf"), timing=case != "nxtomo")
    assert caplog.text.count(SAID) == (is_parallel and form in ("data-exchange", "nxtomo", "rtk"))
    assert form != "phyradgs" or "fps" not in caplog.text  # frames that fill a third of their time are no question


def test_r2_gaussian(tmp_path, make_truth, assert_same) -> None:
    truth = make_truth()
    path = w.write_r2(tmp_path / "r2", truth)
    assert recognise(path) == "r2"
    for one in (path, w.write_naf(tmp_path / "chest.pickle", truth)):
        assert import_scan(one).frames == truth.scan.frames - 2
    assert import_scan(path, ImportOptions(part="test")).frames == 2
    assert_same(import_scan(path, ALL), truth)
    path = w.write_phyradgs(tmp_path / "phyradgs", make_truth(fly=True))
    assert_same(import_scan(path, form="r2"), truth)  # at rest


def test_data_exchange(tmp_path, make_truth, assert_same) -> None:
    """Some beamlines store one mean image (v, u) of flats and darks, without an axis of frames."""
    truth = make_truth()
    path = w.write_data_exchange(tmp_path / "scan.h5", truth, dead=(2, 11))
    assert recognise(path) == "data-exchange"
    assert_same(scan := import_scan(path, ImportOptions(**CONE)), truth, grid=False)
    assert scan.pixel_mask.shape == truth.scan.geometry.detector_shape
    assert list(zip(*np.nonzero(scan.pixel_mask), strict=True)) == [(2, 11)]
    for name in ("data_white", "data_dark"):
        on(f"exchange/{name}", changed(lambda stack: stack.mean(axis=0)))(path)
    assert_same(import_scan(path, ImportOptions(**CONE)), truth, grid=False)


@pytest.mark.parametrize("flips", [(True, False), (False, True)])
def test_nxtomo(tmp_path, make_truth, assert_same, caplog, flips) -> None:
    """What the format does not say, the option does, after the flips that the file declares; a line says what is assumed."""
    truth = make_truth(geometry=replace(make_truth().scan.geometry, detector_offset_mm=(0.0, -6.0)))
    path = w.write_nxtomo(tmp_path / "theirs.nx", truth, flips)
    assert recognise(path) == "nxtomo"
    assert_same(scan := import_scan(path), truth, grid=False, timing=False)
    assert scan.shutter.exposure_s == pytest.approx(0.4) and scan.title == "theirs"
    assert "row 0 is taken as the lowest" in caplog.text and "say row_0 top" in caplog.text
    assert "an exposure of 0.4 s and no time from frame to frame: taken at rest; say frame_time_s or fps" in caplog.text
    caplog.clear()
    on("entry0000/instrument/detector/data", changed(lambda frames: frames[:, ::-1]))(path)
    assert_same(import_scan(path, ImportOptions(row_0="top")), truth, grid=False, timing=False)
    assert "row 0" not in caplog.text


@pytest.mark.parametrize("way", ["plain", "imagej", "planar", "volumetric", "tiled", "big-endian", "deflated", "SimpleITK"])
def test_tiff_of_many_pages(tmp_path, make_truth, assert_same, way) -> None:
    """One file of projections, one of flats and one of darks; three flats are what tifffile takes for a colour image."""
    truth = make_truth()
    path = w.write_tiff(tmp_path / "tiff", truth)
    for name in ("proj", "flat", "dark"):
        files = sorted(path.glob(f"{name}_*.tif"))
        stack = np.stack([w.tifffile.imread(file) for file in files]).astype(np.float32)
        for file in files:
            file.unlink()
        w.write_pages(path / f"{name}_all.tif", stack, way)
    assert_same(scan := import_scan(path), truth, grid=False, pixels=1e-5)
    assert recognise(path) == "tiff" and scan.grid.is_close(truth.scan.grid)


def test_tiff_with_a_file_of_angles(tmp_path, make_truth, assert_same) -> None:
    """Given one by one, angles may go with frames whose numbering has holes."""
    truth = make_truth()
    path = w.write_tiff(tmp_path / "tiff", truth, angles="file = 'angles.txt'\nunit = 'rad'")
    lines = [f"{value!r}  # frame {i}" for i, value in enumerate(truth.angle_rad.tolist())]
    (path / "angles.txt").write_text("# of the gantry\n\n" + "\n".join(lines) + "\n")
    (path / "proj_5.tif").rename(path / "proj_11.tif")
    assert_same(import_scan(path), truth, grid=False)


def test_stored_words_can_be_overruled(tmp_path, make_truth, assert_same) -> None:
    """Frames stored bottom up and mirrored, angles of the sample: the options say so, the file does not."""
    truth = make_truth()
    path = w.write_tiff(tmp_path / "tiff", truth, angles=f"values_deg = {(-np.rad2deg(truth.angle_rad)).tolist()}")
    for file in path.glob("*.tif"):
        w.tifffile.imwrite(file, np.ascontiguousarray(w.tifffile.imread(file)[::-1, ::-1]))
    options = ImportOptions(row_0="bottom", column_0="right", rotates="sample")
    assert_same(import_scan(path, options), truth, grid=False)
