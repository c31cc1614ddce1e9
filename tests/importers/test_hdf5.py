"""HDF5 files as beamlines have them: links, virtual datasets, bare arrays at addresses, pixels at the sample, units."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from damage import attribute, on, put, value

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan, load_volume
from phyradgs_cl.importers.options import option_name

pytestmark = pytest.mark.slow
KEY = np.repeat([2, 1, 0, 1], [1, 2, 6, 2])
ANGLE_DEG = np.where(KEY == 0, np.cumsum(KEY == 0) * 20.0 - 20.0, np.nan)
FRAMES = np.choose(KEY, [20000, 50000, 100])[:, None, None] * np.ones((1, 4, 5))
FRAMES[KEY == 0, :, 1] = 10000.0


def nxtomo(path: Path, entry: str = "entry", added: dict[str, object] | None = None, **arrays: object) -> Path:
    """A small NXtomo with what is ``added``; ``arrays`` replace datasets, by their last names."""
    values: dict[str, object] = {
        "instrument/detector/data": FRAMES.astype(np.uint16), "instrument/detector/image_key": KEY,
        "instrument/detector/x_pixel_size": 0.0065, "instrument/detector/y_pixel_size": 0.0065,
        "sample/rotation_angle": ANGLE_DEG, **(added or {}),
    }  # fmt: skip
    with h5py.File(path, "a") as file:
        group = file.create_group(entry)
        group["definition"] = "NXtomo"
        for address, value in values.items():
            group[address] = arrays.get(address.rpartition("/")[2], value)
    return path


def same(path: Path, options: ImportOptions | None = None) -> None:
    """The scan is the one of ``nxtomo``."""
    scan = import_scan(path, options or ImportOptions())
    assert scan.frames == 6 and scan.projections.shape == (6, 4, 5)
    expected = np.log((50000 - 100) / (np.array([20000, 10000]) - 100))
    np.testing.assert_allclose(scan.projections[:, 0, :2], np.tile(expected, (6, 1)), rtol=1e-5)
    angle = [float(np.rad2deg(scan.trajectory.angle_rad(f, scan.frame_start_s[f : f + 1]))[0]) for f in range(6)]
    np.testing.assert_allclose(np.unwrap(np.deg2rad(angle)), np.deg2rad(-20.0 * np.arange(6)), atol=1e-6)


def moved(path: Path, other: Path, link: object) -> None:
    """The frames lie in another file, and a link in their place."""
    with h5py.File(path, "r+") as file, h5py.File(other, "a") as outside:
        detector = file["entry/instrument/detector"]
        outside["raw/frames"] = detector["data"][()]
        del detector["data"]
        if isinstance(link, h5py.VirtualLayout):
            detector.create_virtual_dataset("data", link, fillvalue=0)
        else:
            detector["data"] = link


def test_bare_arrays_without_addresses_are_told_how_to_name_them(tmp_path) -> None:
    """MATLAB's file begins with a text, and its axes are reversed."""
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file["proj"] = FRAMES[KEY == 0].swapaxes(1, 2)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["proj"] = FRAMES
    with open(tmp_path / "a.mat", "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(126) + b"IM")
    with pytest.raises(InputError, match=r"a file of MATLAB; .* say at projections=/NAME, and at axes=frame,u,v"):
        import_scan(tmp_path / "a.mat")
    with pytest.raises(InputError, match="no NXentry group; .* say at projections=/ADDRESS"):
        import_scan(tmp_path / "b.h5")
    given = {"at": ("projections=/proj", "axes=frame,u,v"), "flat_value": 5e4, "angles": "0,20", "pixel_size_mm": (1.0, 1.0)}
    assert import_scan(tmp_path / "a.mat", ImportOptions(**given)).projections.shape == (6, 4, 5)


@pytest.mark.parametrize("shape", [(-1, 1), (1, -1), (1, 1, -1)])
def test_rows_and_columns_are_lists_as_in_matlab(tmp_path, shape) -> None:
    """Angles, keys, exposures, times, monitor; those of the wrong number are refused."""
    seconds = {"instrument/detector/count_time": np.full(KEY.size, 0.1).reshape(shape), "control/data": np.ones(KEY.size)}
    seconds["instrument/detector/frame_start_time"] = np.arange(KEY.size).reshape(shape)
    lists = {"image_key": KEY.reshape(shape), "rotation_angle": ANGLE_DEG.reshape(shape)}
    same(nxtomo(tmp_path / "a.nxs", added=seconds, **lists))
    light = np.linspace(1.0, 0.5, KEY.size)
    same(lit(tmp_path / "b.nxs", light, **{"control/data": light.reshape(shape)}))
    bare(tmp_path)
    with h5py.File(tmp_path / "p.hdf", "r+") as file:
        for name, count in (("row", 6), ("short", 5)):
            file[name] = ANGLE_DEG[KEY == 0][:count].reshape(shape)
    pixels = {"pixel_size_mm": (0.1, 0.1)}
    same(tmp_path / "p.hdf", ImportOptions(at=(*AT[:3], "angles=/row", AT[-1]), **pixels))
    for at in ("angles=/short", "angles=/entry/data/data"):
        with pytest.raises(InputError, match=rf"{at[7:]}: found shape .*; expected shape \(6\)"):
            import_scan(tmp_path / "p.hdf", ImportOptions(at=(*AT[:3], at, AT[-1]), **pixels))


def test_frames_in_linked_files_of_the_folder_are_read(tmp_path) -> None:
    (tmp_path / "raw").mkdir()
    moved(nxtomo(tmp_path / "a.nxs"), tmp_path / "raw/x.h5", h5py.ExternalLink("raw/x.h5", "/raw/frames"))
    layout = h5py.VirtualLayout(FRAMES.shape, np.uint16)
    for part in (slice(0, 5), slice(5, len(FRAMES))):
        layout[part] = h5py.VirtualSource("y.h5", "raw/frames", FRAMES.shape)[part]
    moved(nxtomo(tmp_path / "b.nxs"), tmp_path / "y.h5", layout)
    with h5py.File(tmp_path / "c.nxs", "w") as file:  # a soft link over an external one
        file["scan"] = h5py.ExternalLink("b.nxs", "/entry")
        file["entry"] = h5py.SoftLink("/scan")
    for name in "abc":
        same(tmp_path / f"{name}.nxs")


def test_a_link_out_of_the_folder_needs_the_option(tmp_path) -> None:
    (tmp_path / "scan").mkdir()
    (tmp_path / "raw").mkdir()
    link = h5py.ExternalLink("../raw/x.h5", "/raw/frames")
    moved(path := nxtomo(tmp_path / "scan/a.nxs"), tmp_path / "raw/x.h5", link)
    with pytest.raises(InputError, match=r"a link to the file .*raw/x.h5.*--linked-folder"):
        import_scan(path)
    same(path, ImportOptions(linked_folder=tmp_path / "raw"))


@pytest.mark.parametrize(("name", "count", "words"), [("gone.h5", 11, "gone.h5"), ("x.h5", 6, "are kept nowhere")])
def test_virtual_data_that_are_not_there_are_no_zeros(tmp_path, name, count, words) -> None:
    """HDF5 answers with the fill value."""
    layout = h5py.VirtualLayout(FRAMES.shape, np.uint16)
    layout[:count] = h5py.VirtualSource(name, "raw/frames", FRAMES.shape)[:count]
    moved(path := nxtomo(tmp_path / "a.nxs"), tmp_path / "x.h5", layout)
    with pytest.raises(InputError, match=words):
        import_scan(path)


def test_the_entry_is_found_by_its_definition(tmp_path, caplog) -> None:
    with h5py.File(path := tmp_path / "a.nxs", "w") as file:
        file.create_group("entry").attrs["NX_class"] = "NXentry"  # of something else
        file["gone"] = h5py.ExternalLink("nowhere.h5", "/")
    same(nxtomo(path, "scan1/tomo", image_key=KEY.astype(np.float32)))
    nxtomo(path, "scan2/tomo", rotation_angle=2 * ANGLE_DEG)
    with pytest.raises(InputError, match=r"several entries: /scan1/tomo, /scan2/tomo.*--entry"):
        import_scan(path)
    same(path, ImportOptions(entry="scan1/tomo"))
    with h5py.File(path, "r+") as file:
        file.attrs["default"] = "scan1/tomo"
    same(path)
    assert "2 NXtomo entries; /scan1/tomo is taken" in caplog.text


def test_the_control_key_counts_before_the_key(tmp_path) -> None:
    """nxtomo marks frames by which it aligns with −1 there, and leaves them projections in the other key."""
    control = np.where((KEY == 0) & (np.cumsum(KEY == 0) > 4), -1, KEY)
    scan = import_scan(nxtomo(tmp_path / "a.nxs", added={"instrument/detector/image_key_control": control}))
    assert scan.frames == 4 and "4 of 2 times" in scan.provenance["taken"]


def bare(folder: Path) -> None:
    with h5py.File(folder / "p.hdf", "w") as file:
        file["entry/data/data"] = FRAMES[KEY == 0].transpose(1, 0, 2)[:, :, None]  # sinograms, with an axis of one
        file["theta"] = np.deg2rad(ANGLE_DEG[KEY == 0])
        file["theta"].attrs["units"] = "Radians"
    for name, kind in (("flat.h5", 1), ("dark.h5", 2)):
        with h5py.File(folder / name, "w") as file:
            file["data"] = FRAMES[kind == KEY].transpose(1, 0, 2)


AT = ("projections=/entry/data/data", "flats=flat.h5:/data", "darks=dark.h5:/data", "angles=/theta", "axes=v,frame,u")


def test_bare_arrays_in_several_files_by_options(tmp_path) -> None:
    bare(tmp_path)
    same(tmp_path / "p.hdf", ImportOptions(at=AT, pixel_size_mm=(0.1, 0.1)))
    for wrong, words in (((*AT, "flat=x"), "NAME=FILE:/ADDRESS"), ((*AT[:-1], "axes=z,y,x"), "frame, v and u")):
        with pytest.raises(InputError, match=words):
            import_scan(tmp_path / "p.hdf", ImportOptions(at=wrong, pixel_size_mm=(0.1, 0.1)))


@pytest.mark.parametrize("angles", ['[angles]\nfile = "p.hdf:/theta"\nrotates = "sample"', ""])
def test_bare_arrays_in_several_files_by_a_toml(tmp_path, angles) -> None:
    bare(tmp_path)
    short = "" if angles else 'angles = "p.hdf:/theta"'
    text = (
        '[frames]\nprojections = "p.hdf:/entry/data/data"\nflats = ["flat.h5:/data"]\ndarks = "dark.h5:/data"\n'
        f'axes = "v, frame, u"\n{short}\n{angles}\n[source]\nbeam = "parallel"\n'
        "[detector]\npixel_size_v_mm = 0.1\npixel_size_u_mm = 0.1\n"
    )
    (tmp_path / "scan.toml").write_text(text)
    same(tmp_path, None if angles else ImportOptions(rotates="sample"))
    (tmp_path / "scan.toml").write_text(text.replace("flat.h5", "../flat.h5"))
    with pytest.raises(InputError, match=r"\[frames\] flats.*inside the folder"):
        import_scan(tmp_path / "scan.toml")


CONE = {"instrument/source/distance": -100.0, "instrument/detector/distance": 100.0}


@pytest.mark.parametrize(("added", "side_mm"), [
    ({"sample/x_pixel_size": 0.65e-6, "sample/y_pixel_size": 0.65e-6}, 0.00065),  # without units: metres
    ({"instrument/detector/x_magnified_pixel_size": 0.00065}, 0.00065),  # one side for both
    ({"sample/x_pixel_size": 0.002, "sample/y_pixel_size": 0.002, **CONE}, 0.004), ({}, 0.0065),
])  # fmt: skip
def test_the_pixel_at_the_sample_counts_and_grows_with_a_cone_beam(tmp_path, added, side_mm) -> None:
    path = nxtomo(tmp_path / "a.nxs", added=added)
    assert import_scan(path).geometry.pixel_size_mm == pytest.approx((side_mm, side_mm))


@pytest.mark.parametrize(("added", "side_mm"), [
    ({"detector/actual_pixel_size_x": (1.3, "microns")}, 0.0013),
    ({"detection_system/objective/resolution": (0.69, "")}, 0.00069),
    ({"detector/pixel_size_x": (6.5e-6, ""), "detection_system/objective/magnification": (10.0, "")}, 0.00065),
    ({"detector/x_pixel_size": (2.4, "um"), "objective/magnification": (5.0, "")}, 0.00048),
    ({"detector/pixel_size": (5.0, "um"), "detector/objective/magnification": (20, "")}, 0.00025),
    ({"detector/pixel_size": (5.0, "um"), "detection_system/objective/magnification": (np.array([b"2.5X"]), "")}, 0.002),
    ({"detector/pixel_size": (5.0, "um"), "detection_system/objective/camera_objective": ("Mitutoyo 5x", "")}, 0.001),
])  # fmt: skip
def test_data_exchange_of_beamlines(tmp_path, added, side_mm, caplog) -> None:
    """Flats before and after, and no angles."""
    with h5py.File(path := tmp_path / "a.h5", "w") as file:
        file["exchange/data"] = FRAMES[KEY == 0]
        for name, counts in (("data_white_pre", 50000.0), ("data_white_post", 40000.0), ("data_dark", 100.0)):
            file[f"exchange/{name}"] = np.full((2, 4, 5), counts)
        for address, (value, unit) in added.items():
            file[where := f"measurement/instrument/{address}"] = value
            if unit:
                file[where].attrs["units"] = unit
    scan = import_scan(path, ImportOptions(quantity="counts"))
    assert scan.geometry.pixel_size_mm == pytest.approx((side_mm, side_mm)) and "no angles: 0° to 180°" in caplog.text
    expected = np.log((np.array([50000 - 10000 / 12, 40000 + 10000 / 12]) - 100) / 19900)  # within the first and last
    np.testing.assert_allclose(scan.projections[[0, -1], 0, 0], expected, rtol=1e-3)
    stated = ImportOptions(quantity="counts", angles="0,30", at=("angles=/exchange/nothing",))
    turned = import_scan(path, stated)  # --angles comes before --at
    last_deg = abs(float(np.rad2deg(turned.trajectory.angle_rad(5, np.array([5.0])))[0]))
    assert last_deg % 360 in (pytest.approx(150), pytest.approx(210))


def exchange(path: Path, **values: object) -> Path:
    """A Data Exchange file, flats twice as bright as ``same`` has them; ``values`` by address below /, with / as __."""
    with h5py.File(path, "w") as file:
        counts = np.choose(KEY, [20000, 99900, 100])[:, None, None] * np.ones((1, 4, 5))
        counts[:, :, 1] = np.where(KEY == 0, 10000, counts[:, 0, 1])[:, None]
        for name, kind in (("data", 0), ("data_white", 1), ("data_dark", 2)):
            file[f"exchange/{name}"] = counts[kind == KEY]
        file["exchange/theta"] = ANGLE_DEG[KEY == 0]
        file["measurement/instrument/detector/pixel_size"] = 0.0065
        for address, value in values.items():
            file[address.replace("__", "/")] = value
    return path


DIFFERENT = "process__acquisition__flat_fields__different_flat_exposure"
FLAT_S, FRAME_S = "process__acquisition__flat_fields__flat_exposure_time", "measurement__instrument__detector__exposure_time"


@pytest.mark.parametrize("word", ["Different", np.frombuffer(b"Different\0\0", np.uint8)[None]])
def test_flats_of_another_exposure_are_scaled_where_data_exchange_says_so(tmp_path, caplog, word) -> None:
    same(exchange(tmp_path / "a.h5", **{DIFFERENT: word, FLAT_S: [0.06], FRAME_S: [0.03]}))
    assert "flats are exposed 2 times as long as projections" in caplog.text
    alike = import_scan(exchange(tmp_path / "b.h5", **{DIFFERENT: "Same", FLAT_S: [0.06], FRAME_S: [0.03]}))
    np.testing.assert_allclose(alike.projections[:, 0, 0], np.log(99800 / 19900), rtol=1e-5)
    with pytest.raises(InputError, match="flat_exposure_time: found nothing there"):
        import_scan(exchange(tmp_path / "c.h5", **{DIFFERENT: "Different", FRAME_S: [0.03]}))


def lit(path: Path, times: np.ndarray, flat_exposure: float = 1.0, **added: object) -> Path:
    """The scan of ``nxtomo`` in light that varies by ``times`` (F,), its flats exposed ``flat_exposure`` times as long."""
    light = times * np.where(KEY == 1, flat_exposure, 1.0)
    on("entry/instrument/detector/data", value(100 + (FRAMES - 100) * light[:, None, None]))(nxtomo(path, added=added))
    return path


@pytest.mark.parametrize(("exposure", "is_rate"), [(1.0, True), (2.0, True), (0.25, True), (4.0, False), (1.0, False)])
def test_exposures_and_the_monitor_of_the_beam_in_nxtomo(tmp_path, caplog, exposure, is_rate) -> None:
    """A monitor counts over the exposure, or has the ring's current. Flats of two times do not see the dip between them."""
    times = 1 - 0.3 * np.sin(np.linspace(0.0, np.pi, len(KEY)))
    seconds = np.where(KEY == 2, np.nan, np.where(KEY == 1, 0.2 * exposure, 0.2))
    monitor = 150 * times * (1.0 if is_rate else np.where(KEY == 1, exposure, 1.0))
    added = {"instrument/detector/count_time": seconds, "control/data": monitor}
    same(path := lit(tmp_path / "a.nxs", times, exposure, **added))
    assert "control/data: frames are divided by it (0." in caplog.text and "say at monitor=none to leave" in caplog.text
    assert ("times as long" in caplog.text) == (exposure != 1)
    assert np.ptp(import_scan(path, ImportOptions(at=("monitor=none",))).projections[:, 0, 0]) > 0.05


@pytest.mark.parametrize("monitor", [np.ones(3), np.logspace(0, 2, len(KEY)), np.where(KEY == 1, np.nan, 1.0)])
def test_a_monitor_that_is_none_is_not_used(tmp_path, caplog, monitor) -> None:
    same(nxtomo(tmp_path / "a.nxs", added={"control/data": monitor}))
    assert "control/data is not used: it lacks a number above 0" in caplog.text


def test_the_source_of_a_beamline_is_so_far_that_its_beam_is_parallel(tmp_path, caplog) -> None:
    added = {"instrument/source/distance": -90.0, "instrument/detector/distance": 10.0}
    path = nxtomo(tmp_path / "a.nxs", added=added, x_pixel_size=2e-5, y_pixel_size=1e-5)  # metres
    scan = import_scan(path)
    assert scan.is_parallel and scan.geometry.pixel_size_mm == pytest.approx((0.009, 0.018))
    assert "a source 90 m away, whose fan moves rays by" in caplog.text and "a parallel beam" in caplog.text
    assert import_scan(path, ImportOptions(source_to_axis_mm=5e4, source_to_detector_mm=5.1e4)).is_parallel
    wide = {"data": np.ones((11, 1, 9000)) * FRAMES[:, :1, :1], "x_pixel_size": 9e-5, "y_pixel_size": 9e-5}
    with pytest.raises(InputError, match=r"source/distance: found a source 90 m away.*\[source\] beam = 'parallel'"):
        import_scan(nxtomo(tmp_path / "b.nxs", added=added, **wide))


EXPOSED = {FRAME_S: [0.03]}
STATED = "measurement__instrument__detector__"


@pytest.mark.parametrize(("values", "words"), [
    ({"acquire_period": 0.04}, "0.03 s and 25 frames per second .*acquire_period.*: taken at rest; say frame_time_s or fps"),
    ({"frame_rate": [20.0]}, "and 20 frames per second .*frame_rate"), ({}, "0.03 s and no time from frame to frame: taken"),
    ({"binning_x": "1x1", "binning_y": [4]}, "binning_y is 4 and not used: say pixel_size_mm"),
])  # fmt: skip
def test_what_a_file_states_and_is_not_used_is_named(tmp_path, caplog, values, words) -> None:
    import_scan(exchange(tmp_path / "a.h5", **EXPOSED, **{f"{STATED}{name}": value for name, value in values.items()}))
    assert re.search(words, caplog.text)


@pytest.mark.parametrize("axes", ["y:theta:x", ["y", "theta", "x"]])
def test_axes_that_are_not_used_and_the_rate_of_nxtomo_are_named(tmp_path, caplog, axes) -> None:
    on("exchange/data", attribute("axes", axes))(path := exchange(tmp_path / "a.h5"))
    import_scan(path)
    assert "@axes is y:theta:x and not used: say at axes=v,frame,u" in caplog.text
    caplog.clear()
    import_scan(path, ImportOptions(at=("axes=frame,v,u",)))
    assert "not used" not in caplog.text
    with pytest.raises(InputError, match="at monitor: found /exchange/current; expected none"):
        import_scan(path, ImportOptions(at=("monitor=/exchange/current",)))
    times = {"instrument/detector/count_time": 0.1, "instrument/detector/frame_start_time": 0.5 * np.arange(len(KEY))}
    import_scan(nxtomo(tmp_path / "a.nxs", added=times))
    assert "an exposure of 0.1 s and 2 frames per second" in caplog.text


def test_measured_exposures_and_values_at_darks(tmp_path, caplog) -> None:
    times = np.where(KEY == 2, np.nan, 0.1)
    times[KEY == 0] += 5e-4 * np.arange(6) / 5
    path = nxtomo(tmp_path / "a.nxs", added={"instrument/detector/count_time": times})
    assert import_scan(path).shutter.exposure_s == pytest.approx(0.10025)
    fly, apart = ImportOptions(fps=1.0), np.where(KEY == 2, np.nan, 0.1 * np.cumsum(KEY == 0))
    path = nxtomo(tmp_path / "b.nxs", added={"instrument/detector/count_time": apart})
    with pytest.raises(InputError, match="--exposure-ms"):
        import_scan(path, replace(fly, named=option_name))
    assert import_scan(path, replace(fly, exposure_s=0.2)).shutter.exposure_s == 0.2
    same(path)
    assert "not used, because the gantry stops" in caplog.text


def test_a_file_that_another_program_writes_is_said(tmp_path) -> None:
    path = nxtomo(tmp_path / "a.nxs")
    words = [sys.executable, "-c", f"import h5py; f = h5py.File({str(path)!r}, 'a'); print(1, flush=True); input()"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True) as other:
        try:
            other.stdout.readline()
            with pytest.raises(InputError, match="another program.*HDF5_USE_FILE_LOCKING"):
                import_scan(path)
        finally:
            other.kill()


def test_a_missing_filter_is_named(tmp_path) -> None:
    packed = {"chunks": (1, 4, 5), "compression": 511, "allow_unknown_filter": True}
    with h5py.File(path := nxtomo(tmp_path / "a.nxs"), "r+") as file:
        put(file, "entry/instrument/detector/data", shape=FRAMES.shape, dtype=np.uint16, **packed)
    with pytest.raises(InputError, match="filter 511.*hdf5plugin"):
        import_scan(path)


def test_scales_and_axes_of_stacks(tmp_path, caplog) -> None:
    values, path = np.ones((3, 4, 5), np.float32), tmp_path / "v.tif"
    for unit, voxel_mm in (("micron", 0.001), ("\\u00B5m", 0.001), ("cm", 10.0), ("pixel", None)):
        about = {"spacing": 2.0, "axes": "ZYX", "unit": unit}
        tifffile.imwrite(path, values, imagej=True, resolution=(1.0, 1.0), metadata=about)
        grid = load_volume(path).grid
        assert (grid and grid.voxel_size_mm) == (voxel_mm and pytest.approx((2 * voxel_mm, voxel_mm, voxel_mm)))
    assert "the scale is left out" in caplog.text
    ome = {f"PhysicalSize{axis}": size for axis, size in zip("XYZ", (1.0, 1.0, 2.0), strict=True)}
    tifffile.imwrite(tmp_path / "v.ome.tif", values, metadata={"axes": "ZYX", **ome})
    assert load_volume(tmp_path / "v.ome.tif").required_grid.voxel_size_mm == pytest.approx((0.002, 0.001, 0.001))
    tifffile.imwrite(path, np.stack([values] * 2), imagej=True, metadata={"axes": "TZYX"})
    with pytest.raises(InputError, match="2 times"):
        load_volume(path)
