"""Folders and descriptions as scanners and people leave them: names, flats, angles, texts, packed images."""

import struct
from pathlib import Path
from typing import Any

import laboratory_of_importers as lab
import numpy as np
import pytest
import tifffile
from PIL import Image

from phyradgs_cl.acquisition import ConeGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan
from phyradgs_cl.importers.angles import read_angles_rad
from phyradgs_cl.importers.series import flat_places, series_of
from phyradgs_cl.importers.text import number_at_start

pytestmark = pytest.mark.slow
CENTRED = ConeGeometry(512.0, 1024.0, (10, 14), (2.5, 2.5))
COUNT = 24
NAMES = {  # a name for each frame, in the order of the scan
    "an index and the beam": lambda i: f"x_{i + 1:03d}_{80 + i % 2}kV.tif",
    "a date before the index": lambda i: f"2023-11-02_bone_{i:04d}.tif",
    "an index and a falling angle": lambda i: f"p{i}_{90 - 7.5 * i:.1f}deg.tif",
    "angles alone": lambda i: f"rot_{-45 + 3.75 * i:g}deg.tif",
    "angles with commas": lambda i: f"p_{3.75 * i:.2f}".replace(".", ",") + "°.tif",
    "measured angles": lambda i: f"theta={7.5 * i + 0.1 * (i % 3):.2f}.tif",
    "clock times over midnight": lambda i: f"a 2024-05-0{'67'[i > 11]}T{('23.59', '00.00')[i > 11]}.{(48 + i) % 60:02d}.tif",
    "milliseconds": lambda i: f"f_{1712345678000 + 250 * i + i % 3}.tif",
    "cameras that alternate": lambda i: f"cam{'LR'[i % 2]}_{i:05d}.tif",
    "turn and frame": lambda i: f"t{i // 8}_f{i % 8}.tif",
    "a version": lambda i: f"v1.{i}.tif",
}  # fmt: skip


@pytest.mark.parametrize("kind", NAMES)
def test_names_are_read_as_a_person_reads_them(kind) -> None:
    """The order is right whatever the order of the listing, and a frame that is missing is seen."""
    paths = [Path("/scan") / NAMES[kind](i) for i in range(COUNT)]
    series = series_of([paths[i] for i in np.random.default_rng(1).permutation(COUNT)], "/scan", "complete it")
    assert series.paths == paths and f"{COUNT} files, {paths[0].name} to {paths[-1].name}" in series.said
    with pytest.raises(InputError, match="a hole in the numbering.*complete it"):
        series_of([path for i, path in enumerate(paths) if i != 13], "/scan", "complete it")


def test_strays_other_series_and_numbers_that_disagree(caplog) -> None:
    frames = [f"bone{i:04d}.tif" for i in range(30)]
    paths = [Path(name) for name in (*frames, "bone_0deg.tif", "bone_180deg.tif", "bone0004 (1).tif")]
    assert [path.name for path in series_of(paths, "here", "").paths] == frames
    assert "3 files are no frames" in caplog.text and "bone_180deg.tif" in caplog.text
    two = [Path(f"{kv}kV_{i:03d}.tif") for kv in ("low", "high") for i in range(9)]
    with pytest.raises(InputError, match="several series of files: low.*high"):
        series_of(two, "here", "")
    with pytest.raises(InputError, match="several series"):  # numbers that go on from one word to the next
        series_of([Path(f"{'open' if i < 9 else 'bone'}_{i:03d}.tif") for i in range(20)], "here", "")
    golden = [Path(f"g_{i:02d}_{i * 111 % 180}deg.tif") for i in range(20)]
    assert series_of(golden[::-1], "here", "").paths == golden and "say [frames] order = 2" in caplog.text
    by_angle = [path.stem.split("_")[2] for path in series_of(golden, "here", "", order=2, holes=True).paths]
    assert by_angle == sorted(by_angle, key=lambda text: int(text[:-3]))


def test_flats_have_places_by_words_and_by_numbers() -> None:
    series = series_of([Path(f"p_{i:03d}.tif") for i in range(12, 32)], "", "")
    flats, darks = [Path(f"f_{i:03d}.tif") for i in (2, 3, 32, 33)], [Path(f"d_{i:03d}.tif") for i in (*range(4, 12),)]
    np.testing.assert_array_equal(np.concatenate(flat_places(flats, darks, series)), [2, 3, 32, 33, *range(12, 32)])
    assert flat_places(flats, darks[1:], series) is None
    words = [Path("flat_before_0.tif"), Path("flat_after_0.tif")]
    np.testing.assert_array_equal(np.concatenate(flat_places(words, [], series)), [-0.5, 19.5, *range(20)])


def toml_folder(
    folder: Path, frames: list[np.ndarray], text: str = "", angles: str = "step_deg = 15.0", **stacks: Any
) -> Path:
    """A folder of frames, of flats and darks by the names of ``stacks``, and a TOML that leaves the projections out."""
    folder.mkdir()
    (folder / "scan.toml").write_text(
        f"[frames]\nquantity = 'counts'\n{text}\n[source]\nto_axis_mm = 500\nto_detector_mm = 800\n[detector]\n"
        f"pixel_size_v_mm = 1\npixel_size_u_mm = 1\n[angles]\n{angles}\n"
    )
    for name, images in {"p": frames, **stacks}.items():
        for i, image in enumerate(images):
            tifffile.imwrite(folder / f"{name}_{i:03d}.tif", image)
    return folder


def shot(counts: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(int(counts) + seed).poisson(counts, (8, 9)).astype(np.uint16)


PATTERNS = 'flats = "white_*.tif"\ndarks = "dark_*.tif"'


def test_what_flats_and_darks_name_is_no_projection_and_odd_files_do_not_matter(tmp_path) -> None:
    frames = [shot(30000 - 900 * i) for i in range(8)]
    folder = toml_folder(tmp_path / "a", frames, PATTERNS, white=[shot(40000, i) for i in range(3)], dark=[shot(50)])
    for name in ("._p_000.tif", "p_000.tif.md5", "Thumbs.db"):
        (folder / name).write_bytes(b"\0\5")
    (folder / "p_003.tif").symlink_to((folder / "p_003.tif").rename(tmp_path / "raw_003.tif"))
    (folder / "p_004.tif").rename(folder / "p_004.TIF")
    scan, truth = import_scan(folder), -np.log((np.stack(frames)[:, ::-1] - 50.0) / 39950)
    assert scan.frames == 8 and np.abs(scan.projections - truth).max() < 0.1
    assert scan.provenance["taken"].startswith("frames: 8 files, p_000.tif to p_007.tif, by number 1 in their names, 0 to 7")
    (folder / "scan.toml").write_text((folder / "scan.toml").read_text().replace(PATTERNS, "flat_value = 4e4"))
    with pytest.raises(InputError, match="several series of files: p_000.tif and 7 more, white_000.tif and 2 more"):
        import_scan(folder)


OTHER_THAN_STATED = {  # by what the TOML says: frames that are something else, made of line integrals
    "quantity = 'transmission'": [lambda p: 100 * np.exp(-p), lambda p: 255 * np.exp(-p), lambda p: 65535 * np.exp(-p)],
    "flat_value = 100.0": [lambda p: 40000 * np.exp(-p)], "quantity = 'attenuation'": [lambda p: -3 * p],
    "flat_value = 40000.0": [lambda p: np.exp(-p), lambda p: p], "flats = 'white_*.tif'": [lambda p: np.exp(-p)],
}  # fmt: skip


def test_pixels_that_are_not_what_is_stated_are_refused(tmp_path, caplog) -> None:
    """Percents, other flats, a reversed sign; and what was divided by the air, beside thousands of counts."""
    p = np.broadcast_to(np.linspace(0, 1.5, 9, dtype=np.float32), (6, 8, 9))
    for number, (text, frames) in enumerate(OTHER_THAN_STATED.items()):
        stated = text if "quantity" in text else f"quantity = 'counts'\n{text}"
        for kind, frames_of in enumerate(frames):
            folder = toml_folder(tmp_path / f"{number}{kind}", list(np.float32(frames_of(p))), white=[shot(40000)])
            toml = (folder / "scan.toml").read_text().replace("quantity = 'counts'", stated)
            (folder / "scan.toml").write_text(toml)
            if "white" not in text:
                (folder / "white_000.tif").unlink()
            said = "quantity: found " + ("fractions" if "40" in text or "white" in text else "line integrals down to")
            with pytest.raises(InputError, match=said):
                import_scan(folder)
    (folder / "scan.toml").write_text(toml.replace("'counts'", "'transmission'"))
    np.testing.assert_allclose(import_scan(folder).projections, p[:, ::-1], atol=1e-6)
    assert "transmissions?" not in caplog.text
    folder = toml_folder(tmp_path / "air", list(np.exp(-np.abs(p - 0.75).max() + np.abs(p - 0.75))))
    (folder / "scan.toml").write_text((folder / "scan.toml").read_text().replace("'counts'", "'attenuation'"))
    import_scan(folder)
    assert "1 at their borders, and less within: are they transmissions? Say [frames] quantity transmission" in caplog.text


def test_a_flat_or_dark_unlike_the_others_is_named_and_left_out(tmp_path, caplog) -> None:
    frames = [shot(20000, i) for i in range(6)]
    good = {"white": [shot(40000, i) for i in range(5)], "dark": [shot(60, i) for i in range(4)]}
    usual = import_scan(toml_folder(tmp_path / "good", frames, PATTERNS, **good)).projections
    assert not caplog.messages
    shaded = shot(40000, 9)
    shaded[:, :4] //= 2  # the object in a corner of a flat
    for number, (name, image) in enumerate({"white": shot(55), "dark": shot(38000), "white ": shaded}.items()):
        stacks = {key: [*images[:2], image, *images[2:]] if key == name.strip() else images for key, images in good.items()}
        scan = import_scan(toml_folder(tmp_path / f"{number}", frames, PATTERNS, **stacks))
        assert np.abs(scan.projections - usual).max() < 0.02
        assert f"{name.strip()}_002.tif is unlike the other" in caplog.text
        caplog.clear()
    import_scan(toml_folder(tmp_path / "two", frames, PATTERNS, white=[shot(40000), shot(55)], dark=good["dark"]))
    assert "white_000.tif, white_001.tif are unlike each other" in caplog.text


def test_flats_are_interpolated_in_time(tmp_path) -> None:
    """A beam that falls by a fifth: with its flats before and after the scan air stays at 0."""
    beam = np.linspace(40000, 32000, 10)
    folder = toml_folder(
        tmp_path / "a", [shot(counts) for counts in beam], 'flats = "white_*.tif"', angles="step_deg = 30",
        white_before=[shot(40000, i) for i in range(5)], white_after=[shot(32000, i) for i in range(5)],
    )
    air = import_scan(folder)
    assert np.abs(air.projections.mean((1, 2))).max() < 0.02 and "10 of 2 times, interpolated" in air.provenance["taken"]
    assert np.ptp(import_scan(folder, ImportOptions(flats="median")).projections.mean((1, 2))) > 0.15
    for i, path in enumerate(sorted(folder.glob("white_after*"), reverse=True) + sorted(folder.glob("white_before*"))):
        path.rename(folder / f"white_{9 - i}.tif")  # nothing says when they were taken
    assert "median of" in import_scan(folder).provenance["taken"]
    assert "assumed: the first 5 before" in import_scan(folder, ImportOptions(flats="time")).provenance["taken"]
    with pytest.raises(InputError, match="^flats: found 1 of one time"):
        import_scan(folder, ImportOptions(flats="time", flat_value=4e4))


ANGLES = {
    "an index from 0": "".join(f"{i} {a}\n" for i, a in enumerate(range(0, 90, 15))),
    "an index that falls": "".join(f"{6 - i};{a}\n" for i, a in enumerate(range(75, -1, -15))),
    "names": "no\tTheta (deg)\ttime\n" + "".join(f"{i}\t{15 * i}\t{7 * i}\n" for i in range(6)),
    "words with rad in them": "radiograph,angle_deg\n" + "".join(f"{i},{15 * i}.0\n" for i in range(6)),
    "radians by the column": "radial shift;angleRad\n" + "".join(f"0.1;{np.deg2rad(15 * i)}\n" for i in range(6)),
    "an index behind, that falls": "theta_deg\tno\n" + "".join(f"{15 * i}.0\t{i}\n" for i in range(5, -1, -1)),
    "decimal commas": "".join(f"{15 * i},00\n" for i in range(6)),
    "one line": ", ".join(f"{15 * i}" for i in range(6)),
    "commas": "".join(f"{i},{15 * i}.0\n" for i in range(6)),
    "Windows": ("\ufeff" + "".join(f"{15 * i}\r\n" for i in range(6))).encode("utf-16-le"),
}  # fmt: skip


def test_files_of_angles(tmp_path) -> None:
    for kind, text in ANGLES.items():
        (tmp_path / "a.txt").write_bytes(text if isinstance(text, bytes) else text.encode())
        np.testing.assert_allclose(read_angles_rad(tmp_path / "a.txt", 6), np.deg2rad(15 * np.arange(6)), err_msg=kind)
    wrong = {"0 1 2\n3 4 5\n": "one angle a line", "0,1\n1,2\n2,4\n": "a decimal comma, or two", "7\n8\n": "2 angles"}
    wrong["p0.tif,0.0\n"] = "line 1: found 'p0.tif,0.0'"
    for text, said in wrong.items():
        (tmp_path / "a.txt").write_text(text)
        with pytest.raises(InputError, match=said):
            read_angles_rad(tmp_path / "a.txt", 3)


LINE = {"index": "{i} {a}", "index behind": "{a} {i}", "time": "{t} {a}", "time and more": "{t} {a} 7", "alone": "{a}"}
NAMED = {  # by what a line has: names above it, and units in a turn of their angles
    "index": {
        **dict.fromkeys(("frame angle", "Projection Angle", "no. angle", "proj stage_deg", "Proj # Angle (°)"), 360),
        **dict.fromkeys(("frame gantry", "rotation angle", "# index omega", "# made by\n# frame theta\n# -- --"), 360),
        **dict.fromkeys(("frame angle_mrad", "frame angle (mrad)", "frame\tangle\n#\tmrad", "# in mrad"), 2000 * np.pi),
    },
    "index behind": {"angle index": 360, "Winkel [Grad], Nr": 360, "angle_rad no": 2 * np.pi},
    "time": {"time rot": 360, "dose rot": 360, "temp_degC srot": 360, "s_rad angle": 360, "time,angle\ns,rad": 2 * np.pi},
    "time and more": {"x rot y": 360, "time rotation (gon) dose": 400, "Time(s) Angle(deg) rot_speed": 360},
    "alone": {
        **{"rotation angle": 360, "θ/°": 360, "angle (decimal degrees)": 360, "anglerad": 2 * np.pi, "arcmin": 21600},
        **{"angle_mdeg": 360e3, "mRad": 2e3 * np.pi, "Angle(µrad)": 2e6 * np.pi, "arcsec": 1296e3, "turns": 1, "rot_rev": 1},
        **{"# angle [rad]\n# made by x": 2 * np.pi, "# angle of 3.11.\n# angle [mrad]\n# of 3.11.": 2000 * np.pi},
    },
}  # fmt: skip
CONTRADICTED = {
    "index": {
        **dict.fromkeys(("rot frame", "Angle table", "theta beta"), "column .*numbers that count; .*tabs or commas"),
        **{"frame dose": "'dose'", "frame angle (counts)": "'counts' in 'angle.counts.'"},
    },
    "time": {"my table": "one angle a line", "angle theta": "one angle a line", "a table of theta": "one angle a line"},
    "time and more": {"time position temp_degC": "one angle a line", "angles": "one angle a line"},
    "alone": {
        **{"angle [0.01 deg]": "'0.01 deg'", "# angle [0.01 deg]": "'0.01 deg'", "encoder_counts": "'counts'"},
        **{"angle (deg/s)": "deg/s", "angleMilliRad": "Milli", "angle [grad]": "'grad' .*mrad", "time_s": "'time' and 's'"},
        **{"degrees, then rad": "'degrees' and 'rad'", "rot [arc sec]": "'arc sec'", "angle [°x100]": "'°x100'"},
    },
}  # fmt: skip


def table_of_angles(path: Path, what: str, names: str, turn: float) -> Path:
    lines = [LINE[what].format(i=i, t=0.5 * i + 3, a=turn * i / 24) for i in range(6)]
    path.write_text("\n".join([names, *lines]), "utf-8")
    return path


def test_names_above_a_table_say_which_column_has_the_angles_and_their_unit(tmp_path) -> None:
    for what, turns in NAMED.items():
        for names, turn in turns.items():
            found = read_angles_rad(table_of_angles(tmp_path / "a.txt", what, names, turn), 6)
            np.testing.assert_allclose(found, np.deg2rad(15 * np.arange(6)), atol=1e-9, err_msg=f"{what}: {names}")
    for what, errors in CONTRADICTED.items():
        for names, said in errors.items():
            with pytest.raises(InputError, match=said):
                read_angles_rad(table_of_angles(tmp_path / "a.txt", what, names, 360), 6)
                pytest.fail(f"taken: {names!r}")
    path = table_of_angles(tmp_path / "a.txt", "index", "frame,angle", 360)
    with pytest.raises(InputError, match="found 6 angles; expected 12"):  # not a list of twelve
        read_angles_rad(path, 12)
    assert read_angles_rad(table_of_angles(path, "alone", "angle (counts)", 400), 6, "gon")[1] == pytest.approx(np.pi / 12)


def written(form: str, path: Path, truth: Any, **lines: Any) -> Path:
    return getattr(lab, f"write_{form}")(path, truth, **lines)


LACKING = {
    "nikon": {"SrcToDetector": "", "DetectorPixelSizeX": None, "AngularStep": None},
    "skyscan": {"Object to Source (mm)": None, "Image Pixel Size (um)": "", "Rotation Step (deg)": "x"},
    "flexray": {"SDD": "unknown", "Binned pixel size": None, "Voxel size": None, "Last angle": None},
    "zeiss": {"ImageInfo/StoRADistance": None, "ImageInfo/PixelSize": None, "ImageInfo/Angles": None},
}


@pytest.mark.parametrize("form", LACKING)
def test_options_come_before_what_the_file_lacks_or_spells_wrongly(tmp_path, make_truth, form) -> None:
    path = written(form, tmp_path / "scan", make_truth(geometry=CENTRED), **LACKING[form])
    lengths = {"source_to_axis_mm": 512.0, "source_to_detector_mm": 1024.0, "pixel_size_mm": (2.5, 2.5)}
    scan = import_scan(path, ImportOptions(**lengths, angles="10,25", row_0="bottom"))
    assert scan.geometry.pixel_size_mm == pytest.approx((2.5, 2.5)) and scan.frames == 6
    with pytest.raises(InputError, match="say angles"):
        import_scan(path, ImportOptions(**lengths))


@pytest.mark.parametrize("code", ["utf-16", "cp1252"])
def test_names_are_text_and_commas_are_decimal(tmp_path, make_truth, code) -> None:
    truth = make_truth(geometry=CENTRED)
    plain, path = import_scan(lab.write_nikon(tmp_path / "plain", truth)), lab.write_nikon(tmp_path / "nikon", truth)
    text = (path / "scan.xtekct").read_text().replace("Name=scan", "Name=3e2 Zähne").replace("2.5", "2,5")
    (path / "scan.xtekct").write_bytes(text.replace("[Xrays]", "Units=MM\r\n[Xrays]").replace(".0", ",0").encode(code))
    for file in path.glob("*.tif"):
        file.rename(path / file.name.replace("scan", "3e2 Zähne"))
    scan = import_scan(path)
    assert scan.geometry == plain.geometry
    np.testing.assert_array_equal(scan.projections, plain.projections)


def test_nikon_s_measured_angles_are_used_in_whatever_order_they_are_listed(tmp_path, make_truth, caplog) -> None:
    truth = make_truth(geometry=CENTRED)
    measured = np.rad2deg(truth.angle_rad) + [0, 0.4, -0.3, 0.2, 0, 0.6]
    head = "nProjs nFrames\n6 1\nProjection Time(s) Angle"
    for number, (name, names, listed) in enumerate((
        *(("scan.ang", "Proj:Angle(deg)", one) for one in (measured, measured[::-1] - 9, 200 - measured)),
        ("_ctdata.txt", f"{head}(deg)", measured), ("_ctdata.txt", f"{head}(rad)".replace(" ", "\t"), np.deg2rad(measured)),
    )):  # fmt: skip
        path = lab.write_nikon(tmp_path / str(number), truth)
        lines = "".join(f"{i + 1}{':' if name == 'scan.ang' else f' {0.5 * i}'}\t{a:.6f}\r\n" for i, a in enumerate(listed))
        (path / name).write_text(f"{names}\r\n{lines}")
        scan = import_scan(path)
        angle_deg = [np.rad2deg(scan.trajectory.angle_rad(i, scan.frame_start_s[i])) for i in range(6)]
        np.testing.assert_allclose(angle_deg, measured, atol=1e-3)
    assert "scan.ang: these measured angles are used; they differ from equal steps by 0.6°" in caplog.text


def renumber(folder: Path, by: int) -> None:
    for file in sorted(folder.glob("scan_*0*.tif"), reverse=by > 0):
        file.rename(folder / f"scan_{int(file.stem[5:]) + by:0{len(file.stem) - 5}d}.tif")


def test_more_and_fewer_files_than_a_description_states(tmp_path, make_truth, caplog) -> None:
    for form, digits in (("nikon", 4), ("skyscan", 8)):
        path = written(form, tmp_path / form, make_truth(geometry=CENTRED))
        last = sorted(path.glob("scan_*0*.tif"))[-1]
        (beyond := path / f"scan_{int(last.stem[5:]) + 1:0{digits}d}.tif").write_bytes(last.read_bytes())
        whole = import_scan(path)
        assert whole.frames == 6 and f"left out: {beyond.name}" in caplog.text
        other = {"nikon": -1, "skyscan": 1}[form]  # from another number on any file may be the surplus one
        renumber(path, other)
        with pytest.raises(InputError, match=r"found 7 files, scan_0*[01].tif to scan_0*[67].tif; expected 6"):
            import_scan(path)
        renumber(path, -other)
        beyond.unlink()
        (path / f"scan_{int(last.stem[5:]) - 2:0{digits}d}.tif").unlink()
        with pytest.raises(InputError, match="5 files .* say frames found"):
            import_scan(path)
        part, at = import_scan(path, ImportOptions(frames="found")), [0, 1, 2, 4, 5]
        np.testing.assert_array_equal(part.projections, whole.projections[at])
        found, full = (scan.trajectory.kinematics.angle_start_rad for scan in (part, whole))
        np.testing.assert_allclose(found, full[at])


@pytest.mark.parametrize("form", ["nikon", "skyscan"])
def test_images_that_the_scanner_has_divided_by_the_air(tmp_path, make_truth, form) -> None:
    path = written(form, tmp_path / form, make_truth(geometry=CENTRED))
    whole = import_scan(path)
    for file in path.glob("scan_*0*.tif"):
        tifffile.imwrite(file, np.float32(tifffile.imread(file) / lab.WHITE))
    with pytest.raises(InputError, match="quantity: found fractions, .* air at 60000 counts; .* Say quantity transmission"):
        import_scan(path)
    shares = import_scan(path, ImportOptions(quantity="transmission"))
    np.testing.assert_allclose(shares.projections, whole.projections, atol=1e-6)


def test_xradia_s_scans_that_stopped_early_and_have_several_references(tmp_path, make_truth, caplog) -> None:
    truth = make_truth(geometry=CENTRED)
    whites = {f"MultiReferenceData/Image{i + 1}": np.full((10, 14), lab.WHITE + i - 1, np.float32) for i in range(3)}
    streams = {"ReferenceData/Image": None, "MultiReferenceData/DataType": np.int32(10), **whites}
    stopped = {"ImageInfo/ImagesTaken": np.int32(4), "ImageData1/Image6": None}
    scan = import_scan(lab.write_zeiss(tmp_path / "a", truth, **streams, **stopped))
    np.testing.assert_array_equal(scan.projections, lab.line_integrals_of(lab.counts16(truth))[:4])
    assert "a.txrm: the scan stopped early: 4 of 6 images" in caplog.text and "median of 3" in scan.provenance["taken"]
    path = lab.write_zeiss(tmp_path / "b", truth, **{"ImageData1/Image6": None})
    assert import_scan(path, ImportOptions(frames="found")).frames == 5


def packed_12_bit(path: Path, image: np.ndarray) -> None:
    """A TIFF of 12 bits a pixel, two pixels in three bytes."""
    rows, columns = image.shape
    bits = np.unpackbits(image.astype(">u2").view(np.uint8).reshape(rows, columns, 2), axis=-1)[:, :, 4:]
    data = np.packbits(bits.reshape(rows, -1), axis=-1).tobytes()
    values = ((256, columns), (257, rows), (258, 12), (259, 1), (262, 1), (273, 8), (277, 1), (278, rows), (279, len(data)))
    tags = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in values)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8 + len(data)) + data + struct.pack("<H", len(values)) + tags + bytes(4))


@pytest.mark.parametrize("way", ["tiff_lzw", "packbits", "12 bits"])
def test_packed_tiffs_are_read(tmp_path, way) -> None:
    frames = np.stack([shot(3000 - 100 * i) for i in range(6)])[:, :, :8]
    folder = toml_folder(tmp_path / "a", list(frames), "flat_value = 4000.0")
    for i, image in enumerate(frames):
        path = folder / f"p_{i:03d}.tif"
        packed_12_bit(path, image) if way == "12 bits" else Image.fromarray(image).save(path, compression=way)
    np.testing.assert_allclose(np.exp(-import_scan(folder).projections) * 4000, frames[:, ::-1], rtol=1e-5)


def test_numbers_in_texts() -> None:
    read = {"0,25 mm": (0.25, "mm"), "1.234,5": (1234.5, ""), "2,500.5um": (2500.5, "um"), "12 week": (12.0, "week")}
    read["-3E-2"] = (-0.03, "")
    assert {text: number_at_start(text) for text in read} == read
    assert all(number_at_start(text) is None for text in ("1,500", "week 12", "1.2.3", ""))
    assert number_at_start("1,500", comma_is_decimal=True) == (1.5, "")
