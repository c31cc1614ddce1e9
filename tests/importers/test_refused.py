"""Mistakes in files of other programs: each is one error that names the field. And what no file may do, whoever wrote it."""

import json
import os
import pickle
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
import writers_of_importers as w
from damage import attribute, on, removed, value

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan, load_volume

CONE = ImportOptions(source_to_axis_mm=500.0, source_to_detector_mm=800.0)
REAL = ImportOptions(pixel_size_mm=(3.0, 2.5))
OPTIONS = {"phyradgs-real": REAL, "data-exchange": CONE}
Damage = Callable[[Path], object]


def text(name: str, old: str, new: str) -> Damage:
    """Another text in a file of the folder."""

    def damage(path: Path) -> None:
        content = (path / name).read_bytes().decode("latin-1")
        assert old in content, old
        (path / name).write_bytes(content.replace(old, new, 1).encode("latin-1"))

    return damage


def meta(change: Callable[[dict[str, Any]], object], name: str = "meta_data.json") -> Damage:
    """Another value in a JSON of the folder."""

    def damage(path: Path) -> None:
        change(content := json.loads((path / name).read_text()))
        (path / name).write_text(json.dumps(content))

    return damage


def named(name: str) -> Damage:
    return meta(lambda m: m["proj_train"][0].update(file_path=name))


def pickled(change: Callable[[dict[str, Any]], object]) -> Damage:
    def damage(path: Path) -> None:
        change(content := pickle.loads(path.read_bytes()))
        path.write_bytes(pickle.dumps(content))

    return damage


def image(name: str, shape: tuple[int, ...], **how: Any) -> Damage:
    return lambda path: tifffile.imwrite(path / name, np.zeros(shape, np.uint16), **{"photometric": "minisblack", **how})


FPS, GEO = "meta_data_motion_blur_rolling_shutter_fps18.json", "geometric_motion_rs.json"
XML, MHA, CURVED = "geometry.xml", "projections.mha", "<RadiusCylindricalDetector>9</RadiusCylindricalDetector>"
ONE_MORE = "<Projection><GantryAngle>1</GantryAngle></Projection>"
TOML, XTEK, PARAMS = "scan.toml", "scan.xtekct", "params.txt"
DETECTOR, ENTRY = "entry0000/instrument/detector", "entry0000"
STEPS = ("values_deg", "step_deg = 25 #")
MISTAKES: dict[str, dict[str, Damage]] = {  # by format: the field, or what a message names, and what is done to it
    "r2": {
        "DSD": meta(lambda m: m["scanner"].update(DSD=400)),
        "mode": meta(lambda m: m["scanner"].update(mode="fan")),
        "proj_train[1].angle": meta(lambda m: m["proj_train"][1].pop("angle")),
        "grid shape": meta(lambda m: m["scanner"].update(nVoxel=[10**6] * 3)),
        "again": meta(lambda m: m["proj_train"].append(m["proj_train"][0])),
        "3 of 4 views at one angle": meta(lambda m: [one.update(angle=0.5) for one in m["proj_train"][:3]]),
        "0000.npy": lambda path: (path / "proj_train/0000.npy").unlink(),
    },
    "phyradgs": {
        "simulate_train[2].last_line_end": meta(lambda m: m["simulate_train"][2].pop("last_line_end"), FPS),
        "exposure": meta(lambda m: m["simulate_train"][1].update(first_line_end=-9), FPS),
        "readout": meta(lambda m: m["simulate_train"][1].update(last_line_end=9), FPS),
    },
    "phyradgs-real": {
        "views[1].detector": meta(lambda m: m["views"][1]["detector"].pop(), GEO),
        "orthonormal": meta(lambda m: m["views"][0]["detector"][0].__setitem__(1, 0.7), GEO),
        "5 TIFF files for 6 views": lambda path: (path / "projections/3.tif").unlink(),
    },
    "naf": {
        "train.projections": pickled(lambda d: d["train"].pop("projections")),
        "(4, 3, 3)": pickled(lambda d: d["train"].update(projections=np.zeros((4, 3, 3)))),
        "train.angles": pickled(lambda d: d["train"].update(angles=np.zeros(2))),
        "image": pickled(lambda d: d.update(image=np.zeros((2, 2, 2)))),
    },
    "rtk": {
        "SourceToIsocenterDistance": text(XML, "Distance>500.0<", "Distance>0<"),
        "SourceToDetectorDistance": text(XML, "Distance>800.0<", "Distance>80<"),
        "GantryAngle": text(XML, "<GantryAngle>", "<GantryAngle>ten "),
        "RadiusCylindricalDetector": text(XML, "<Projection>", f"{CURVED}<Projection>"),
        "6 frames, 7": text(XML, "</RTKThree", f"{ONE_MORE}</RTKThree"),
        "version": text(XML, 'version="3"', 'version="2"'),
        "TransformMatrix": text(MHA, "Matrix = 1 0 0 0 1 0 0 0 1", "Matrix = 0 0 1 0 1 0 1 0 0"),
        MHA: text(MHA, "NDims = 3", "NDims = 4"),
    },
    "data-exchange": {
        "/exchange/theta": on("exchange/theta", value(np.zeros(3))),
        "grad": on("exchange/theta", attribute("units", "grad")),
        "data_white": on("exchange/data_white", value(np.ones((1, 2, 3)))),
        "no usable value": on("exchange/data_white", value(np.zeros((1, 10, 14)))),
        "what the pixels hold": on("exchange/data_white", removed),
        "pixel_size": on("measurement", removed),
    },
    "nxtomo": {
        "source/distance": on(f"{ENTRY}/instrument/source/distance", value(0.0)),
        "image_key_control": on(f"{DETECTOR}/image_key_control", value(np.ones(9, int))),
        "transformations/rx": on(f"{DETECTOR}/transformations/rx", value(12.0)),
        "x_translation": on(ENTRY, lambda f, a: f.__setitem__(f"{a}/sample/x_translation", np.arange(9.0))),
        "phyradgs": on(ENTRY, lambda f, a: f.create_group(f"{a}/phyradgs")),
    },
    "tiff": {
        "angels": text(TOML, "[angles]", "[angels]"),
        "step_deg and values_deg": text(TOML, "[angles]", "[angles]\nstep_deg = 2"),
        "values_deg": text(TOML, "values_deg = [", "values_deg = [1, 2] # ["),
        "no file that matches": text(TOML, '"proj_*.tif"', '"x_*.tif"'),
        "(10, 14, 3)": image("proj_1.tif", (10, 14, 3), photometric="rgb"),
        "one number": lambda path: (text(TOML, *STEPS)(path), (path / "proj_3.tif").rename(path / "proj_02.tif")),
        "Orientation": image("proj_1.tif", (10, 14), extratags=[(274, 3, 1, 6, True)]),
        "100 images and 1 of them": image("proj_1.tif", (10, 14), description="ImageJ=1.54\nimages=100\n"),
        "start times": text(TOML, "[frames]", "[timing]\nexposure_s = 1\nstart_s = [0, 0, 0, 0, 0, 0]\n[frames]"),
    },
    "leap": {
        "geometry": text(PARAMS, "geometry = cone", "geometry = fan"),
        "(7, 10, 14)": text(PARAMS, "numAngles = 6", "numAngles = 7"),
        "phis": text(PARAMS, "phis = 100.0, ", "phis = "),
        "sourcePositions": text(PARAMS, "geometry = cone", "geometry = modular"),
    },
}  # fmt: skip


@contextmanager
def at_most(peak_bytes: float) -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < peak_bytes
    finally:
        tracemalloc.stop()


def refused(path: Path, options: ImportOptions | None, form: str, said: str) -> None:
    with pytest.raises(InputError) as caught:
        import_scan(path, options, form)
    assert said in str(caught.value) and len(str(caught.value).splitlines()) == 1, caught.value


@pytest.mark.parametrize("form", [pytest.param(one, marks=pytest.mark.slow) if one == "nxtomo" else one for one in MISTAKES])
def test_a_mistake_is_named(tmp_path, make_truth, form) -> None:
    """Those of laboratory scanners: test_laboratory.py."""
    for number, (said, damage) in enumerate(MISTAKES[form].items()):
        (tmp_path / str(number)).mkdir()
        damage(path := w.write(form, tmp_path / str(number), make_truth))
        refused(path, OPTIONS.get(form), form, said)


def in_degrees(table: dict[str, Any]) -> None:
    table.update({key: np.rad2deg(value).tolist() for key, value in table.items() if "angle" in key or "_line_" in key})


ANGLES = {  # what multiplies the angles of a format
    "r2": meta(lambda m: [in_degrees(one) for one in m["proj_train"]]), "naf": pickled(lambda d: in_degrees(d["train"])),
    "phyradgs": meta(lambda m: [in_degrees(one) for one in m["simulate_train"]], FPS),
    "tiff": text(TOML, "values_deg = [", "values_deg = [900"), "rtk": text(XML, "<GantryAngle>", "<GantryAngle>99"),
    "data-exchange": on("exchange/theta", lambda f, a: f[a].__setitem__(..., 100 * f[a][()])),
}  # fmt: skip


def test_angles_over_many_turns_are_questioned(tmp_path, make_truth, caplog) -> None:
    for form, change in ANGLES.items():
        (tmp_path / form).mkdir()
        import_scan(path := w.write(form, tmp_path / form, make_truth), OPTIONS.get(form))
        assert "are they" not in caplog.text, form
        change(path)
        import_scan(path, OPTIONS.get(form))
        said = "rad: are they degrees? np.deg2rad" if form in ("r2", "phyradgs", "naf") else "°: are they in degrees?"
        assert caplog.text.count(said) == 1, form
        caplog.clear()


# --- what no file may do ------------------------------------------------------------------------------------------------


class Bomb:
    """Runs a shell command when it is unpickled by anything that runs what a pickle says."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.canary}",)


def npy(shape: str, descr: str) -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(560)


def test_nothing_in_a_pickle_is_executed(tmp_path, make_truth) -> None:
    canary = tmp_path / "canary"
    for form in ("naf", "tigre"):
        path = w.write(form, tmp_path, make_truth)
        path.write_bytes(pickle.dumps({"tigre.utilities.geometry": 1, "unused": Bomb(canary)}))
        refused(path, None, form, "nothing was executed")
    for opcodes in (b"(S'touch canary'\nios\nsystem\n.", b"cos\nsystem\n(S'touch canary'\ntR.", b"c__builtin__\neval\n."):
        path.write_bytes(opcodes)
        refused(path, None, "naf", "nothing was executed")
    for made in (b"cnumpy\ndtype\n", b"S'os.system'\n"):
        path.write_bytes(b"ccopy_reg\n_reconstructor\n(" + made + b"c__builtin__\nobject\nNtR.")
        refused(path, None, "naf", "a damaged pickle")
    path = w.write("naf", tmp_path, make_truth)
    pickled(lambda d: d["train"].update(projections=np.array([Bomb(canary), None], object)))(path)
    refused(path, None, "naf", "'O8'")
    path = w.write("r2", tmp_path, make_truth)
    (path / "proj_train/0000.npy").write_bytes(npy("(10, 14)", "'|O'"))
    refused(path, None, "r2", "damaged .npy")
    assert not canary.exists()


def test_no_file_leads_out_of_its_folder(tmp_path, make_truth) -> None:
    np.save(tmp_path / "secret.npy", np.full((10, 14), 7.0, np.float32))
    ways = ("../secret.npy", "proj_train/../../secret.npy", "..\\secret.npy", "C:secret.npy", str(tmp_path / "secret.npy"))
    leads = [("r2", named(way)) for way in ways] + [("r2", meta(lambda m: m.update(vol="../secret.npy")))]
    leads += [("rtk", text(MHA, "DataFile = LOCAL", f"DataFile = {way}")) for way in ("../secret.npy", "/etc/passwd")]
    leads += [("tiff", text(TOML, '"proj_*.tif"', f'"{way}"')) for way in ("../proj_*.tif", "/tmp/*.tif")]
    leads += [("tiff", text(TOML, "values_deg", "file = '../angles.txt' #"))]
    leads += [("nikon", text(XTEK, "FolderName=", "FolderName=../in"))]
    for number, (form, damage) in enumerate(leads):
        (tmp_path / str(number)).mkdir()
        damage(path := w.write(form, tmp_path / str(number), make_truth))
        refused(path, None, form, "inside the folder")
    for number, entity in enumerate(("[<!ENTITY x SYSTEM 'file:///etc/passwd'>]", f"SYSTEM '{tmp_path}/secret.npy'")):
        (tmp_path / f"xml {number}").mkdir()
        path = w.write("rtk", tmp_path / f"xml {number}", make_truth)
        text(XML, "<!DOCTYPE RTKGEOMETRY>", f"<!DOCTYPE RTKGEOMETRY {entity}>")(path)
        text(XML, "<GantryAngle>", "<GantryAngle>&x;")(path)
        refused(path, None, "rtk", XML)
    path = w.write("data-exchange", tmp_path, make_truth)
    on("exchange", lambda f, a: (f[a].pop("data"), f[a].__setitem__("data", h5py.ExternalLink("/etc/passwd", "/"))))(path)
    refused(path, CONE, "data-exchange", "passwd")


def test_sizes_are_held_against_this_machine_before_anything_is_unpacked(tmp_path, make_truth, monkeypatch) -> None:
    path = w.write("tiff", tmp_path, make_truth)
    tifffile.imwrite(path / "proj_all.tif", np.zeros((6, 1000, 1000), np.float32), compression="zlib")
    text(TOML, "proj_*", "proj_all")(path)
    monkeypatch.setattr("phyradgs_cl.importers.files.host_bytes", lambda: 50e6)
    with at_most(2e6):
        refused(path, None, "tiff", "proj_all.tif: found 0.0503 GiB to unpack; expected at most 0.0373 GiB")
    packed = sitk.GetImageFromArray(np.zeros((200, 200, 200), np.float32))
    sitk.WriteImage(packed, str(tmp_path / "v.nrrd"), useCompression=True)
    with pytest.raises(InputError, match="to unpack"):
        load_volume(tmp_path / "v.nrrd")
    path = w.write("r2", tmp_path, make_truth)
    (path / "proj_train/0000.npy").write_bytes(npy("(1000000, 1000000)", "'<f4'"))
    refused(path, None, "r2", "damaged .npy")


@pytest.mark.slow
def test_a_good_stack_takes_twice_its_line_integrals(tmp_path, make_truth) -> None:
    """The frames as stored and their line integrals, one byte per pixel for the mask, and blocks."""
    path = w.write_tiff(tmp_path / "tiff", make_truth(), angles="step_deg = 10")
    frames = np.random.default_rng(0).integers(1000, 50000, (16, 250, 250)).astype(np.float32)
    for name, stack in (("proj", frames), ("flat", frames[:2]), ("dark", frames[:1] * 0)):
        tifffile.imwrite(path / f"{name}_all.tif", stack, compression="zlib", photometric="minisblack")
        text(TOML, f"{name}_*", f"{name}_all")(path)
    with at_most(2.5 * 4 * frames.size + 8e6):
        import_scan(path)


def test_frames_of_r2_are_found_by_names_of_a_simulation(tmp_path, make_truth) -> None:
    path = w.write_r2(tmp_path / "r2", make_truth())
    meta_data = path / "meta_data.json"
    meta_data.write_text(meta_data.read_text().replace(".npy\", ", "_sim1.npy\", ").replace("vol_gt_sim1", "vol_gt"))
    np.testing.assert_array_equal(import_scan(path).projections, make_truth().scan.projections[:4])


def test_what_is_not_recognised_is_said(tmp_path) -> None:
    """A text, a folder of one, of two formats, and nothing."""
    for case, names in {"text": (), "folder": ("a.txt",), "formats": ("a.xml", "a.mha", "a.toml"), "none": None}.items():
        what = tmp_path / case / "what"
        (what if names else what.parent).mkdir(parents=True)
        for path in [what / name for name in names] or [what] if names is not None else ():
            path.write_text("hello")
        with pytest.raises(InputError, match="what: found"):
            import_scan(what)


@pytest.mark.parametrize(("names", "words"), [
    (("FRAME.DBF", "a.HIS"), "Elekta's projections without _Frames.xml"), (("p1.xim",), "Varian's .* Scan.xml"),
    (("geometry.xml", "p.nii.gz"), r"NIfTI \(.nii\), which is not read; .* save projections of RTK as .mha"),
    (("a.rek",), "Fraunhofer"), (("data settings XRE.txt", "s.tif"), "XRE.txt' alone; expected 'scan settings.txt'"),
])  # fmt: skip
def test_known_projections_without_their_description_are_told_what_is_missing(tmp_path, names, words) -> None:
    for name in names:
        (tmp_path / name).write_bytes(b"\0" * 200)
    with pytest.raises(InputError, match=words):
        import_scan(tmp_path)


def test_notes_and_logs_that_are_links_or_folders_do_not_matter(tmp_path, make_truth) -> None:
    """Files that any folder may have, and that some formats describe their scans with."""
    path = w.write("tiff", tmp_path, make_truth)
    (path / "notes.txt").symlink_to(tmp_path / "nowhere")
    (path / "run.log").mkdir()
    assert import_scan(path).frames == 6


def test_what_the_user_names_is_the_user_s_business(tmp_path, make_truth) -> None:
    """A link, unlike one that a file names; a description under another name; an option without use."""
    path = w.write_r2(tmp_path / "r2", make_truth())
    (tmp_path / "link").symlink_to(path)
    assert import_scan(tmp_path / "link").frames == 4
    (path / "other.json").write_text((path / "meta_data.json").read_text().replace('"DSO": 500.0', '"DSO": 400.0'))
    assert import_scan(path / "other.json", form="r2").geometry.source_to_axis_mm == 400
    (path / "other.json").unlink()
    with pytest.raises(InputError, match="^rotates with format r2"):
        import_scan(path, ImportOptions(rotates="sample"))


def test_options_are_checked() -> None:
    for name, wrong in {
        "exposure_s": -1.0, "readout_s": float("nan"), "frame_time_s": 0.0, "angle_at": "end", "readout_direction": 2,
        "pixel_size_mm": (1.0, 0.0), "detector_offset_mm": (float("inf"), 0.0), "quantity": "hounsfield", "flat_value": 0.0,
    }.items():  # fmt: skip
        with pytest.raises(InputError, match=f"^{name}: "):
            ImportOptions(**{name: wrong})


def test_what_is_not_there_is_not_looked_for_elsewhere_and_no_pipe_is_opened(tmp_path, make_truth) -> None:
    os.mkfifo((folder := w.write("rtk", tmp_path, make_truth)) / "pipe")
    for name, words in {"missing.xml": "nothing there", "pipe": "neither a file nor a folder"}.items():
        with pytest.raises(InputError, match=words):
            import_scan(folder / name, None, "rtk")


@pytest.mark.parametrize("name", ["v.nii", "v.nii.gz", "v.mha", "packed.mha", "v.tif"])
def test_images_with_too_few_voxels_are_refused(tmp_path, name) -> None:
    """SimpleITK fills up what is missing in NIfTI, and what is damaged in packed MetaImages. tifffile reads the first page,
    and logs that there are no others."""
    values, path = np.random.default_rng(0).normal(size=(8, 9, 10)).astype(np.float32), tmp_path / name
    if name == "v.tif":
        tifffile.imwrite(path, values, photometric="minisblack")
    else:
        sitk.WriteImage(sitk.GetImageFromArray(values), str(path), useCompression="packed" in name)
    np.testing.assert_array_equal(load_volume(path).values, values)
    content, end = path.read_bytes(), -300 if name == "v.tif" else -8
    spoilt = [content[:-200] + bytes(4) + content[-196:]] if name in ("v.nii.gz", "packed.mha") else []
    for damaged in (content[: len(content) // 2], content[:end], *spoilt):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="bytes of data|a damaged file|pages behind|cannot be read"):
            load_volume(path)
