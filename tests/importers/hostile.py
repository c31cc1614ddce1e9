"""Damage done to good foreign files, format by format: what a stranger, or a broken disk, may hand over."""

import json
import os
import pickle
import struct
import sys
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import laboratory_of_importers as lab
import numpy as np
import tifffile
import toolkits_of_importers as kits
from corpus.hdf5_damage import REMOVED, attribute, on, value

Damage = Callable[[Path], None]
SECRET = np.full((10, 14), 7.0, np.float32)


def truncated(name: str, keep: float = 0.6) -> Damage:
    def damage(path: Path) -> None:
        file = path / name if name else path
        data = file.read_bytes()
        file.write_bytes(data[: int(len(data) * keep)])

    return damage


def filled(name: str, data: bytes) -> Damage:
    return lambda path: (path / name if name else path).write_bytes(data) and None


def removed(name: str) -> Damage:
    return lambda path: (path / name).unlink()


def in_json(name: str, change: Callable[[dict[str, Any]], object]) -> Damage:
    def damage(path: Path) -> None:
        content = json.loads((path / name).read_text())
        change(content)
        (path / name).write_text(json.dumps(content))

    return damage


def in_text(name: str, old: str, new: str) -> Damage:
    def damage(path: Path) -> None:
        text = (path / name).read_bytes().decode("latin-1")
        assert old in text, old
        (path / name).write_bytes(text.replace(old, new, 1).encode("latin-1"))

    return damage


def outside(path: Path) -> Path:
    """A file beside the folder, which no import may touch."""
    np.save(path.parent / "secret.npy", SECRET)
    return path.parent / "secret.npy"


def named(key: str, name: object) -> Damage:
    """The first frame of an R2 folder under another name."""

    def damage(path: Path) -> None:
        text = str(outside(path)) if name == "ABSOLUTE" else name
        in_json("meta_data.json", lambda meta: meta[key][0].update(file_path=text))(path)

    return damage


def npy_header(shape: str, descr: str = "'<f4'", body: bytes = b"\0" * 560) -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body


class Bomb:
    """Runs a shell command when it is unpickled by anything that runs what a pickle says."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.canary}",)


def pickled(change: Callable[[dict[str, Any], Path], object], protocol: int = 4) -> Damage:
    def damage(path: Path) -> None:
        content = pickle.loads(path.read_bytes())
        content = change(content, path) or content
        path.write_bytes(pickle.dumps(content, protocol))

    return damage


def with_bomb(key: str) -> Damage:
    return pickled(lambda d, path: d.update({key: Bomb(path.parent / "canary")}))


def object_array(d: dict[str, Any], path: Path) -> None:
    d["train"]["projections"] = np.array([Bomb(path.parent / "canary"), None], object)


def doubled(times: int) -> bytes:
    """Opcodes of a tuple of a tuple of ...: short to write, endless to print, to hash or to walk."""
    steps = [b"0h" + bytes([i]) + b"h" + bytes([i]) + b"\x86\x94" for i in range(times)]
    return b"K\x01K\x02\x86\x94" + b"".join(steps)


def tuple_bomb_value(path: Path) -> None:
    path.write_bytes(b"\x80\x04}\x8c\x03DSO" + doubled(60) + b"s.")


def huge_array_pickle(path: Path) -> None:
    """_reconstruct with a shape of a terabyte and hardly any bytes."""
    path.write_bytes(
        b"\x80\x04}\x8c\x05image"
        b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
        b"(K\x01\x8a\x05\x00\x00\x00\x00\x40\x85cnumpy\ndtype\n\x8c\x02f4\x89\x88\x87R"
        b"(K\x03\x8c\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89C\x04\0\0\0\0tbs."
    )


PROJ = "proj_train/0000.npy"
R2: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "no description": (removed("meta_data.json"), ()),
    "not JSON": (filled("meta_data.json", b"\xff\xfe{"), ("JSON",)),
    "a JSON list": (filled("meta_data.json", b"[]"), ("JSON list",)),
    "JSON that is too deep": (filled("meta_data.json", b"[" * 200_000), ("JSON",)),
    "no scanner": (in_json("meta_data.json", lambda m: m.pop("scanner")), ("scanner", "nothing")),
    "a fan beam": (in_json("meta_data.json", lambda m: m["scanner"].update(mode="fan")), ("mode", "'parallel'")),
    "a distance that is text": (in_json("meta_data.json", lambda m: m["scanner"].update(DSO="far")), ("DSO",)),
    "a distance that is NaN": (in_json("meta_data.json", lambda m: m["scanner"].update(DSO=float("nan"))), ("DSO",)),
    "a distance of many digits": (filled("meta_data.json", b'{"scanner": {"DSO": ' + b"9" * 4000 + b"}}"), ("DSO",)),
    "a detector before the axis": (in_json("meta_data.json", lambda m: m["scanner"].update(DSD=400)), ("DSD",)),
    "a detector of no rows": (in_json("meta_data.json", lambda m: m["scanner"].update(nDetector=[0, 4])), ("nDetector",)),
    "half a pixel": (in_json("meta_data.json", lambda m: m["scanner"].update(nDetector=[10, 13.5])), ("nDetector",)),
    "a huge grid": (in_json("meta_data.json", lambda m: m["scanner"].update(nVoxel=[10**6] * 3)), ("grid shape", "at most")),
    "a large grid": (in_json("meta_data.json", lambda m: m["scanner"].update(nVoxel=[4000] * 3)), ("vol_gt",)),
    "no frames": (in_json("meta_data.json", lambda m: m.update(proj_train=[])), ("proj_train",)),
    "a frame without an angle": (in_json("meta_data.json", lambda m: m["proj_train"][1].pop("angle")), ("[1].angle",)),
    "a frame that is no table": (in_json("meta_data.json", lambda m: m["proj_train"].insert(0, 3)), ("proj_train[0]",)),
    "a frame twice": (in_json("meta_data.json", lambda m: m["proj_train"].append(m["proj_train"][0])), ("again",)),
    "a path with ..": (named("proj_train", "../secret.npy"), ("'../secret.npy'", "inside")),
    "a path with .. inside": (named("proj_train", "proj_train/../../secret.npy"), ("inside",)),
    "a Windows path with ..": (named("proj_train", "..\\secret.npy"), ("inside",)),
    "a drive": (named("proj_train", "C:secret.npy"), ("inside",)),
    "an absolute path": (named("proj_train", "ABSOLUTE"), ("inside",)),
    "a name with NUL": (named("proj_train", "a\0b"), ("file_path",)),
    "a name that is a number": (named("proj_train", 3), ("file_path",)),
    "a folder as a frame": (named("proj_train", "proj_train"), ("folder",)),
    "a truth outside": (in_json("meta_data.json", lambda m: m.update(vol="../secret.npy")), ("inside",)),
    "a missing frame": (removed(PROJ), ("no file",)), "a truncated frame": (truncated(PROJ), ("damaged .npy",)),
    "a pickle as a frame": (filled(PROJ, b"cos\nsystem\n(S'touch canary'\ntR."), ("damaged .npy",)),
    "an archive as a frame": (filled(PROJ, b"PK\x03\x04" + b"\0" * 100), ("damaged .npy",)),
    "an object array": (filled(PROJ, npy_header("(10, 14)", "'|O'")), ("damaged .npy", "object")),
    "a structured array": (filled(PROJ, npy_header("(10, 14)", "[('a', '<f4')]")), ("type",)),
    "a frame declared huge": (filled(PROJ, npy_header("(1000000, 1000000)")), ("damaged .npy",)),
    "a frame declared negative": (filled(PROJ, npy_header("(-10, -14)")), ("0000.npy",)),
    "a header that calls": (filled(PROJ, npy_header("__import__('os').system('touch canary')")), ("damaged .npy",)),
    "a frame of another size": (filled(PROJ, npy_header("(14, 10)")), ("(14, 10)",)),
    "a stack as a frame": (filled(PROJ, npy_header("(1, 10, 14)")), ("(1, 10, 14)",)),
    "a truth of another size": (filled("vol_gt.npy", npy_header("(5, 4, 7)")), ("vol_gt.npy",)),
    "a truth with NaN": (filled("vol_gt.npy", npy_header("(8, 9, 7)", body=b"\xff" * 2016)), ("vol_gt.npy", "NaN")),
}  # fmt: skip

FPS = "meta_data_motion_blur_rolling_shutter_fps18.json"
PHYRADGS: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "no marks": (in_json(FPS, lambda m: m["simulate_train"][2].pop("last_line_end")), ("[2].last_line_end",)),
    "no exposure": (in_json(FPS, lambda m: m["simulate_train"][0].update(first_line_end=np.deg2rad(10))), ("exposure",)),
    "one frame backwards": (in_json(FPS, lambda m: m["simulate_train"][1].update(first_line_end=-9)), ("exposure",)),
    "readouts that differ": (in_json(FPS, lambda m: m["simulate_train"][1].update(last_line_end=9)), ("readout",)),
    "a path with ..": (in_json(FPS, lambda m: m["simulate_train"][0].update(file_path="../secret.npy")), ("inside",)),
}  # fmt: skip


def _shutter(meta: dict[str, Any]) -> dict[str, Any]:
    return meta["views"][0]["rolling_shutter"]["source"]


GEO = "geometric_motion_rs.json"
REAL: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "no views": (in_json(GEO, lambda m: m.update(views=[])), ("views",)),
    "a view without its matrix": (in_json(GEO, lambda m: m["views"][1].pop("detector")), ("views[1].detector",)),
    "a matrix of three rows": (in_json(GEO, lambda m: m["views"][1]["detector"].pop()), ("views[1].detector",)),
    "a matrix of text": (in_json(GEO, lambda m: m["views"][0].update(detector=[["a"] * 4] * 4)), ("detector",)),
    "a matrix that shears": (in_json(GEO, lambda m: m["views"][0]["detector"][0].__setitem__(1, 0.7)), ("orthonormal",)),
    "a radius of 0": (in_json(GEO, lambda m: m["rolling_shutter_geometry"]["source"].update(radius=0)), ("radius",)),
    "an angle missing": (in_json(GEO, lambda m: _shutter(m).pop("first_row_end_angle")), ("first_row_end_angle",)),
    "too few frames": (removed("projections/3.tif"), ("5 TIFF files for 6 views",)),
    "a truncated frame": (truncated("projections/3.tif"), ("3.tif",)),
    "two descriptions": (filled("other.json", b"{}"), ("geometric_motion_rs.json, other.json",)),
}  # fmt: skip

NAF: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "empty": (filled("", b""), ("damaged pickle",)), "truncated": (truncated(""), ("damaged pickle",)),
    "not a pickle": (filled("", b"hello, world"), ("damaged pickle",)),
    "a list": (filled("", pickle.dumps([1, 2])), ("table",)),
    "a call of os.system": (with_bomb("DSD"), ("posix.system", "nothing was executed")),
    "a call in an unused key": (with_bomb("unused"), ("posix.system",)),
    "a call by the old opcode": (filled("", b"(S'touch canary'\nios\nsystem\n."), ("os.system",)),
    "a call by GLOBAL": (filled("", b"cos\nsystem\n(S'touch canary'\ntR."), ("os.system",)),
    "eval": (filled("", b"c__builtin__\neval\n(S'1'\ntR."), ("eval",)),
    "a persistent object": (filled("", b"P3\n."), ("persistent",)),
    "an object by NEWOBJ": (pickled(lambda d, _: d.update(DSD=Path("x"))), ("pathlib",)),
    "an array of objects": (pickled(object_array), ("'O8'",)),
    "a complex array": (pickled(lambda d, _: d.update(image=np.zeros((8, 9, 7), complex))), ("c16",)),
    "an array declared huge": (huge_array_pickle, ("in 4 bytes",)),
    "a number of many digits": (filled("", b"I" + b"9" * 100_000 + b"\n."), ("damaged pickle",)),
    "tuples of tuples as a value": (tuple_bomb_value, ("DSO", "a tuple of 2")),
    "bytes declared huge": (filled("", b"\x80\x05\x96" + struct.pack("<Q", 1 << 60) + b"a."), ("damaged pickle",)),
    "a list that holds itself": (filled("", b"\x80\x04}\x8c\x03DSO]\x94h\x00as."), ("DSO",)),
    "an array never filled": (filled("", b"\x80\x04}\x8c\x03DSOcnumpy.core.multiarray\n_reconstruct\n)Rs."), ("DSO",)),
    "a function as a value": (filled("", b"\x80\x04}\x8c\x03DSOcnumpy\ndtype\ns."), ("DSO",)),
    "no projections": (pickled(lambda d, _: d["train"].pop("projections") is None), ("train.projections",)),
    "frames of another size": (pickled(lambda d, _: d["train"].update(projections=np.zeros((4, 3, 3)))), ("(4, 3, 3)",)),
    "too few angles": (pickled(lambda d, _: d["train"].update(angles=np.zeros(2))), ("train.angles", "2 values")),
    "an angle that is NaN": (pickled(lambda d, _: d["train"].update(angles=np.full(4, np.nan))), ("train.angles",)),
    "a truth of another size": (pickled(lambda d, _: d.update(image=np.zeros((2, 2, 2)))), ("image",)),
    "a truth beyond float32": (pickled(lambda d, _: d.update(image=np.full((8, 9, 7), 1e300))), ("image", "float32")),
}  # fmt: skip

ENTITIES = """<!DOCTYPE RTKGEOMETRY [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>"""
EXTERNAL = """<!DOCTYPE RTKGEOMETRY [<!ENTITY x SYSTEM "file:///etc/passwd">]>"""
DOCTYPE = "<!DOCTYPE RTKGEOMETRY>"
SID, CURVED = "SourceToIsocenterDistance", "<RadiusCylindricalDetector>9</RadiusCylindricalDetector>"
ONE_MORE = "<Projection><GantryAngle>1</GantryAngle></Projection>"
PARALLEL = ONE_MORE.replace("</P", "<SourceToDetectorDistance>0</SourceToDetectorDistance></P")
XML, MHA = "geometry.xml", "projections.mha"
RTK: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "entities": (in_text(XML, DOCTYPE, ENTITIES), ("DOCTYPE",)),
    "an external entity": (in_text(XML, DOCTYPE, EXTERNAL), ("DOCTYPE",)),
    "an external DTD": (in_text(XML, DOCTYPE, '<!DOCTYPE RTKGEOMETRY SYSTEM "http://x/y.dtd">'), ("DOCTYPE",)),
    "an undeclared entity": (in_text(XML, "<GantryAngle>", "<GantryAngle>&boom;"), ("well formed",)),
    "truncated XML": (truncated(XML), ("well formed",)), "another root": (filled(XML, b"<svg/>"), ("svg",)),
    "an old version": (in_text(XML, 'version="3"', 'version="2"'), ("version",)),
    "elements without end": (filled(XML, b"<RTKThreeDCircularGeometry>" + b"<a>" * 100_000), ("well formed",)),
    "no distance": (in_text(XML, f"{SID}>500.0</{SID}>", "X>1</X>"), (SID,)),
    "a distance of 0": (in_text(XML, "Distance>500.0<", "Distance>0<"), ("SourceToIsocenterDistance",)),
    "a detector before the axis": (in_text(XML, "Distance>800.0<", "Distance>80<"), ("SourceToDetectorDistance",)),
    "a parallel beam in one projection": (in_text(XML, "</RTKThree", f"{PARALLEL}</RTKThree"), ("or 0 in all projections",)),
    "an angle that is text": (in_text(XML, "<GantryAngle>", "<GantryAngle>ten "), ("GantryAngle",)),
    "an infinite angle": (in_text(XML, "<GantryAngle>", "<GantryAngle>1e999"), ("GantryAngle",)),
    "a curved detector": (in_text(XML, "<Projection>", f"{CURVED}<Projection>"), ("Radius",)),
    "a projection more": (in_text(XML, "</RTKThree", f"{ONE_MORE}</RTKThree"), ("6 frames, 7",)),
    "an encoding that nobody knows": (in_text(XML, '"1.0"?', '"1.0" encoding="klingon"?'), ("geometry.xml",)),
    "no stack": (removed(MHA), ()), "two stacks": (filled("other.mha", b""), ("other.mha",)),
    "a truncated stack": (truncated(MHA), ("bytes",)),
    "a stack declared huge": (in_text(MHA, "DimSize = 14 10 6", "DimSize = 140000 100000 6"), ("bytes",)),
    "a stack declared negative": (in_text(MHA, "DimSize = 14 10 6", "DimSize = -14 -10 6"), ("projections.mha",)),
    "a size that is text": (in_text(MHA, "DimSize = 14", "DimSize = all"), ("projections.mha",)),
    "a size that is infinite": (in_text(MHA, "DimSize = 14", "DimSize = inf"), ("projections.mha",)),
    "voxels outside": (in_text(MHA, "ElementDataFile = LOCAL", "ElementDataFile = ../secret.npy"), ("inside",)),
    "voxels anywhere": (in_text(MHA, "ElementDataFile = LOCAL", "ElementDataFile = /etc/passwd"), ("inside",)),
    "voxels in a list": (in_text(MHA, "ElementDataFile = LOCAL", "ElementDataFile = LIST"), ("LIST",)),
    "four axes": (in_text(MHA, "NDims = 3", "NDims = 4"), ("projections.mha",)),
    "no voxel type": (in_text(MHA, "MET_FLOAT", "MET_OBJECT"), ("projections.mha",)),
    "no spacing": (in_text(MHA, "ElementSpacing = 2.5", "ElementSpacing = 0"), ("projections.mha",)),
    "a skew stack": (in_text(MHA, "TransformMatrix = 1 0 0", "TransformMatrix = 0 0 1"), ("projections.mha",)),
    "no header": (filled(MHA, b"\0" * 100_000), ("header",)),
    "deflated rubbish": (in_text(MHA, "CompressedData = False", "CompressedData = True"), ("CompressedDataSize",)),
}  # fmt: skip


def deflated(data: bytes, change: int = 0) -> Damage:
    """Packed voxels, of which one byte may be changed: SimpleITK leaves the voxels from there on undefined."""

    def damage(path: Path) -> None:
        packed = bytearray(zlib.compress(data))
        packed[len(packed) // 2] ^= change
        says = f"Data = True\nCompressedDataSize = {len(packed)}".encode()
        header = (path / MHA).read_bytes().split(b"LOCAL\n")[0].replace(b"Data = False", says)
        (path / MHA).write_bytes(header + b"LOCAL\n" + packed)

    return damage


RTK["deflated too short"] = (deflated(bytes(800)), ("800 bytes of data",))
RTK["deflated and damaged"] = (deflated(np.arange(840.0, dtype=np.float32).tobytes(), 255), ("decompressing",))


def linked(file: h5py.File, address: str) -> None:
    del file[address]
    file[address] = h5py.ExternalLink("/etc/passwd", "/")


EXCHANGE: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "truncated": (truncated(""), ("HDF5",)),
    "no data": (on("exchange/data", REMOVED), ("/exchange/data",)),
    "data elsewhere": (on("exchange/data", linked), ("/exchange/data", "passwd")),
    "flat data": (on("exchange/data", value(np.zeros(5))), ("/exchange/data",)),
    "text data": (on("exchange/data", value([[["a"]]])), ("/exchange/data",)),
    "too few angles": (on("exchange/theta", value(np.zeros(3))), ("/exchange/theta",)),
    "an angle that is NaN": (on("exchange/theta", value(np.full(6, np.nan))), ("/exchange/theta",)),
    "an unknown unit": (on("exchange/theta", attribute("units", "gon")), ("gon",)),
    "flats of another size": (on("exchange/data_white", value(np.ones((1, 2, 3)))), ("data_white",)),
    "no flats": (on("exchange/data_white", REMOVED), ("what the pixels hold",)),
    "dead flats": (on("exchange/data_white", value(np.zeros((1, 10, 14)))), ("no usable value",)),
    "no pixel size": (on("measurement", REMOVED), ("found nothing; expected a length; say",)),
}  # fmt: skip

DETECTOR = "entry0000/instrument/detector"
MOVES = "entry0000/sample/x_translation"
DISTANCE = "entry0000/instrument/source/distance"
NXTOMO: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "truncated": (truncated(""), ("HDF5",)),
    "no data": (on(f"{DETECTOR}/data", REMOVED), ("detector/data",)),
    "data elsewhere": (on(f"{DETECTOR}/data", linked), ("passwd",)),
    "a distance of 0": (on(DISTANCE, value(0.0)), ("source/distance", "found 0")),
    "no detector distance": (on(f"{DETECTOR}/distance", REMOVED), ("detector/distance", "source_to_detector_mm")),
    "no projections": (on(f"{DETECTOR}/image_key_control", value(np.ones(9, int))), ("image_key",)),
    "a key short": (on(f"{DETECTOR}/image_key_control", value(np.zeros(3, int))), ("image_key",)),
    "a tilted detector": (on(f"{DETECTOR}/transformations/rx", value(12.0)), ("rx", "12")),
    "a sample that moves": (on(MOVES, lambda f, a: f.create_dataset(a, data=np.arange(9.0))), ("x_translation",)),
    "a scan of this package": (on("entry0000/phyradgs", lambda f, a: f.create_group(a)), ("as it is",)),
    "no flats": (on(f"{DETECTOR}/image_key_control", value([3, 3, 0, 0, 0, 0, 0, 0, 3])), ("what the pixels",)),
}  # fmt: skip

TOML = "scan.toml"


def angles_in(text: str | None) -> Damage:
    """A file of angles in place of the list."""

    def damage(path: Path) -> None:
        in_text(TOML, "values_deg", "file = 'angles.txt' #")(path)
        if text is not None:
            (path / "angles.txt").write_text(text)

    return damage


def timed(text: str) -> Damage:
    return in_text(TOML, "[frames]", f"[timing]\n{text}\n[frames]")


def stepped(damage: Damage) -> Damage:
    """Angles by a step, so that only the numbering of the files says which frame is which."""

    def both(path: Path) -> None:
        in_text(TOML, "values_deg", "step_deg = 25 #")(path)
        damage(path)

    return both


def same_name(path: Path) -> None:
    """proj_2.tif and proj_2.tiff, both of them projections."""
    (path / "proj_3.tif").rename(path / "proj_2.tiff")
    in_text(TOML, "proj_*.tif", "proj_*")(path)


def behind_the_directory(path: Path) -> None:
    """What ImageJ writes beyond 4 GB: one entry in the directory, and the number of images in its description."""
    tifffile.imwrite(path / "proj_1.tif", np.zeros((10, 14)), description="ImageJ=1.54\nimages=100\n")


TURNED = [(274, 3, 1, 6, True)]
STANDING = "[timing]\nexposure_s = 1\nstart_s = [0, 0, 0, 0, 0, 0]\n[frames]"
SAY = "say [timing] frame_time_s or [readout] fps"
TIFF: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "not TOML": (filled(TOML, b"= = ="), ("TOML",)),
    "not text": (filled(TOML, b"\xff\xfe\xff"), ("TOML",)),
    "an unknown table": (in_text(TOML, "[angles]", "[angels]"), ("angels", "angles")),
    "an unknown key": (in_text(TOML, "flats =", "flat ="), ("flat", "flats")),
    "an unknown scanner key": (in_text(TOML, "to_axis_mm", "to_axis"), ("to_axis",)),
    "no angles": (in_text(TOML, "values_deg", "rotates = 'gantry' #"), ("last_deg",)),
    "too few angles": (in_text(TOML, "values_deg = [", "values_deg = [1, 2] # ["), ("values_deg",)),
    "frames outside": (in_text(TOML, '"proj_*.tif"', '"../proj_*.tif"'), ("inside",)),
    "frames anywhere": (in_text(TOML, '"proj_*.tif"', '"/tmp/*.tif"'), ("inside",)),
    "frames everywhere": (in_text(TOML, '"proj_*.tif"', '"**/*.tif"'), ("pattern",)),
    "no frames": (in_text(TOML, '"proj_*.tif"', '"x_*.tif"'), ("no file",)),
    "a frame that is no TIFF": (filled("proj_1.tif", b"GIF89a" + b"\0" * 100), ("proj_1.tif",)),
    "an empty frame": (filled("proj_1.tif", b""), ("proj_1.tif",)),
    "a frame without a page": (filled("proj_1.tif", b"II*\0\0\0\0\0"), ("proj_1.tif",)),
    "a truncated frame": (truncated("proj_1.tif"), ("proj_1.tif",)),
    "a colour frame": (lambda p: tifffile.imwrite(p / "proj_1.tif", np.zeros((10, 14, 3), np.uint8)), ("shape",)),
    "a turned frame": (lambda p: tifffile.imwrite(p / "proj_1.tif", np.zeros((10, 14)), extratags=TURNED), ("Orientation",)),
    "a frame of another size": (lambda p: tifffile.imwrite(p / "proj_1.tif", np.zeros((10, 13))), ("(10, 13)",)),
    "a hole in the numbering": (stepped(removed("proj_3.tif")), ("proj_4.tif after proj_2.tif: a hole", "values_deg")),
    "one number twice": (stepped(lambda p: (p / "proj_3.tif").rename(p / "proj_02.tif")), ("one number",)),
    "one name twice": (stepped(same_name), ("one number",)),
    "two kinds of angles": (in_text(TOML, "[angles]", "[angles]\nstep_deg = 2"), ("step_deg and values_deg",)),
    "a unit of nothing": (in_text(TOML, "[angles]", "[angles]\nunit = 'rad'"), ("[angles] unit",)),
    "no file of angles": (angles_in(None), ("no file", "angles.txt")),
    "angles elsewhere": (in_text(TOML, "values_deg", "file = '../angles.txt' #"), ("inside",)),
    "too few lines of angles": (angles_in("0\n# none\n\n2\n"), ("angles.txt", "2 angles", "6, one for each frame")),
    "a line that is no angle": (angles_in("0\n1\n2 deg\n3\n4\n5"), ("angles.txt line 3", "'2 deg'")),
    "a line that is no number": (angles_in("0\n1\n2\nnan\n4\n5"), ("angles.txt line 4",)),
    "a unit that is none": (in_text(TOML, "values_deg", "unit = 'gon'\nfile = 'a' #"), ("gon",)),
    "images behind the directory": (behind_the_directory, ("100 images and 1 of them",)),
    "an exposure without a frame time": (timed("exposure_s = 1"), ("[timing] exposure_s", SAY)),
    "a readout without a frame time": (timed("readout_s = 1"), ("[timing] readout_s", SAY)),
    "the middle of no exposure": (in_text(TOML, "[angles]", "[angles]\nat = 'middle'"), ("[angles] at", SAY)),
    "exposure without end": (in_text(TOML, "[frames]", "[timing]\nexposure_s = -1\n[frames]"), ("exposure_s",)),
    "motion without exposure": (in_text(TOML, "[frames]", "[timing]\nframe_time_s = 1\n[frames]"), ("[timing] exposure",)),
    "times that stand still": (in_text(TOML, "[frames]", STANDING), ("start times",)),
}  # fmt: skip


def declared_huge(path: Path) -> None:
    """The width and height of a page, raised in its tags; its one strip stays as it is."""
    for compression in (None, "zlib"):
        tifffile.imwrite(path / "proj_1.tif", np.zeros((10, 14)), compression=compression)
        with tifffile.TiffFile(path / "proj_1.tif", mode="r+b") as tiff:
            for tag in ("ImageWidth", "ImageLength", "RowsPerStrip"):
                tiff.pages[0].tags[tag].overwrite(60_000)


def circular_pages(path: Path) -> None:
    """The next-page offset of the first page points at the first page."""
    file = path / "proj_1.tif"
    data = bytearray(file.read_bytes())
    first = struct.unpack_from("<I", data, 4)[0]
    entries = struct.unpack_from("<H", data, first)[0]
    struct.pack_into("<I", data, first + 2 + 12 * entries, first)
    file.write_bytes(data)


TIFF["a frame declared huge"] = (declared_huge, ("(60000, 60000)",))
TIFF["pages in a circle"] = (circular_pages, ())


XTEK = "scan.xtekct"


NIKON: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "an empty description": (filled(XTEK, b""), ("Projections", "nothing")),
    "no text": (filled(XTEK, b"\xff\xfe\0" * 99), ("Projections",)),
    "no number of projections": (in_text(XTEK, "Projections=6", "Projection=6"), ("Projections",)),
    "half a projection": (in_text(XTEK, "Projections=6", "Projections=6.5"), ("Projections",)),
    "too many projections": (in_text(XTEK, "Projections=6", "Projections=1e30"), ("Projections",)),
    "projections that are not there": (in_text(XTEK, "Projections=6", "Projections=7"), ("expected 7", "6 files")),
    "pixels that are not there": (in_text(XTEK, "PixelsX=14", "PixelsX=15"), ("6 × 10 × 15",)),
    "no white level": (in_text(XTEK, "WhiteLevel", "Level"), ("WhiteLevel",)),
    "a white level of 0": (in_text(XTEK, "WhiteLevel=60000.0", "WhiteLevel=0"), ("WhiteLevel",)),
    "a distance of text": (in_text(XTEK, "SrcToObject=500.0", "SrcToObject=far"), ("SrcToObject", "'far'")),
    "a distance of many digits": (in_text(XTEK, "SrcToObject=500.0", "SrcToObject=" + "9" * 400), ("SrcToObject",)),
    "a panel before the axis": (in_text(XTEK, "SrcToDetector=800.0", "SrcToDetector=400"), ("source_to_detector_mm",)),
    "no step": (in_text(XTEK, "AngularStep", "Step"), ("AngularStep",)),
    "an axis that lies down": (in_text(XTEK, "ObjectRoll=0", "ObjectRoll=90"), ("ObjectRoll",)),
    "frames outside": (in_text(XTEK, "FolderName=", "FolderName=../in"), ("InputFolderName", "inside")),
    "a missing frame": (removed("scan_0003.tif"), ("5 files",)),
    "a truncated frame": (truncated("scan_0001.tif"), ("scan_0001.tif",)),
    "a name that is a pattern": (in_text(XTEK, "Name=scan", "Name=(.*)+$"), ("0 files",)),
}  # fmt: skip

LOG = "scan_.log"
SKYSCAN: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "an empty log": (filled(LOG, b""), ("Number of Files",)),
    "another section": (in_text(LOG, "[Acquisition]", "[User]"), ("Number of Files",)),
    "no prefix": (in_text(LOG, "Filename Prefix=scan_", ""), ("Filename Prefix",)),
    "a prefix that leaves the folder": (in_text(LOG, "Prefix=scan_", "Prefix=../in/scan_"), ("0 files",)),
    "too many files": (in_text(LOG, "Files= 6", "Files= 99999999"), ("Number of Files",)),
    "files that are not there": (in_text(LOG, "Files= 6", "Files= 9"), ("expected 9", "6 files")),
    "a path that is no circle": (in_text(LOG, "ROUND", "SPIRAL"), ("Scanning Trajectory", "SPIRAL")),
    "no correction": (in_text(LOG, "Correction=ON", "Correction=OFF"), ("Flat Field Correction", "flat_value")),
    "a pixel of no size": (in_text(LOG, "Size (um)=1562.5", "Size (um)=0"), ("Image Pixel Size (um)",)),
    "a pixel without a ratio": (in_text(LOG, "X/Y Ratio=", "X/Y Ratio=-"), ("Camera X/Y Ratio",)),
    "an axis at infinity": (in_text(LOG, "(line)=", "(line)=1e9"), ("Optical Axis (line)",)),
    "a camera before the object": (in_text(LOG, "Camera to Source (mm)=800", "Camera to Source (mm)=8"), ("detector",)),
    "a step of text": (in_text(LOG, "Step (deg)=25.0", "Step (deg)=small"), ("Rotation Step (deg)", "'small'")),
    "bits without end": (in_text(LOG, "=16\r\nReference Intensity", "=1e9\r\nR"), ("Depth (bits)",)),
    "a hole in the numbering": (lambda p: (p / "scan_00000005.tif").rename(p / "scan_00000007.tif"), ("a hole",)),
}  # fmt: skip

SETTINGS = "scan settings.txt"
FLEXRAY: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "empty settings": (filled(SETTINGS, b"SOD SDD"), ("SOD", "nothing")),
    "no distance": (in_text(SETTINGS, "SDD", "SD"), ("SDD",)),
    "a panel before the axis": (in_text(SETTINGS, "SDD : 800.0", "SDD : 80"), ("source_to_detector_mm",)),
    "no pixel": (in_text(SETTINGS, "Binned pixel size : 3.0", "Binned pixel size : none"), ("Binned pixel size", "'none'")),
    "a window of three": (in_text(SETTINGS, "0,0,1943,1535", "0,0,1943"), ("ROI (LTRB)", "four")),
    "a window of words": (in_text(SETTINGS, "0,0,1943,1535", "a,b,c,d"), ("ROI (LTRB)",)),
    "a window of many digits": (in_text(SETTINGS, "0,0,1943,1535", "0,0,1," + "9" * 5000), ("ROI (LTRB)",)),
    "a place of text": (in_text(SETTINGS, "tra_obj : 0.0;", "tra_obj : left"), ("tra_obj", "'left'")),
    "no last angle": (in_text(SETTINGS, "Last angle", "Angle"), ("Last angle",)),
    "no flats": (lambda p: [(p / f"io00000{i}.tif").unlink() for i in (0, 1)], ("io", "at least one")),
    "flats of another panel": (lambda p: tifffile.imwrite(p / "io000000.tif", np.zeros((9, 14), np.uint16)), ("io000000",)),
    "a truncated frame": (truncated("scan_000002.tif"), ("scan_000002.tif",)),
}  # fmt: skip


def streams(**changes: object) -> Damage:
    """A .txrm written again with other streams, "/" as "__" in their names."""

    def damage(path: Path) -> None:
        truth = sys.modules["conftest_of_importers"].truth(geometry=lab_geometry())
        lab.write_zeiss(path, truth, **{name.replace("__", "/"): value for name, value in changes.items()})

    return damage


def lab_geometry() -> Any:
    conftest = sys.modules["conftest_of_importers"]
    return replace(conftest.GEOMETRY, detector_offset_mm=(0.0, 0.0))


def huge_stream(path: Path) -> None:
    """The size of the first image, in its directory entry, raised to 2 GB."""
    data = bytearray(path.read_bytes())
    at = data.index("Image1\0".encode("utf-16-le"))
    struct.pack_into("<Q", data, at + 120, 1 << 31)
    path.write_bytes(data)


def circular_chain(path: Path) -> None:
    """Every sector of the file allocation table points at sector 0."""
    data = bytearray(path.read_bytes())
    fat = 512 * (1 + struct.unpack_from("<I", data, 76)[0])
    data[fat : fat + 512] = bytes(512)
    path.write_bytes(data)


ZEISS: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "an empty file": (filled("", b""), ("container",)), "no container": (filled("", b"PK\3\4" * 999), ("container",)),
    "a truncated file": (truncated("", 0.5), ("txrm",)), "a header alone": (truncated("", 0.05), ("txrm",)),
    "a stream of 2 GB": (huge_stream, ("txrm",)), "a chain in a circle": (circular_chain, ("txrm",)),
    "no number of images": (streams(ImageInfo__NoOfImages=None), ("NoOfImages", "nothing")),
    "a number without bytes": (streams(ImageInfo__NoOfImages=np.int8(6)), ("NoOfImages", "0 numbers")),
    "no images": (streams(ImageInfo__NoOfImages=np.int32(0)), ("NoOfImages", "found 0")),
    "two milliards of images": (streams(ImageInfo__NoOfImages=np.int32(2**31 - 1)), ("NoOfImages",)),
    "a million images": (streams(ImageInfo__NoOfImages=np.int32(999_999)), ("NoOfImages", "999999")),
    "a thousand images": (streams(ImageInfo__NoOfImages=np.int32(1000)), ("as many as the file can hold",)),
    "a missing image": (streams(ImageData1__Image4=None), ("ImageData1/Image4", "nothing")),
    "an image that is too short": (streams(ImageData1__Image4=np.zeros(99, np.uint16)), ("Image4", "99 pixels")),
    "an image that is too long": (streams(ImageData1__Image4=np.zeros(999, np.uint16)), ("Image4", "at most")),
    "pixels of another type": (streams(ImageInfo__DataType=np.int32(7)), ("DataType", "found 7")),
    "no angles": (streams(ImageInfo__Angles=None), ("Angles",)),
    "too few angles": (streams(ImageInfo__Angles=np.zeros(3, np.float32)), ("Angles", "3 numbers")),
    "an angle that is NaN": (streams(ImageInfo__Angles=np.full(6, np.nan, np.float32)), ("Angles", "nan")),
    "a source that moves": (streams(ImageInfo__StoRADistance=np.float32([500, 510] * 3)), ("StoRADistance", "10")),
    "a source in the axis": (streams(ImageInfo__StoRADistance=np.zeros(6, np.float32)), ("StoRADistance",)),
    "a pixel of no size": (streams(ImageInfo__PixelSize=np.float32(0)), ("PixelSize",)),
    "shifts for some": (streams(**{"Alignment__X-Shifts": np.ones(2, np.float32)}), ("Alignment/X-Shifts", "2 numbers")),
    "no reference": (streams(ReferenceData__Image=None), ("flats", "flat_value")),
    "half a reference": (streams(ReferenceData__Image=np.ones(70, np.float32)), ("ReferenceData/Image", "70 pixels")),
    "a reference of text": (streams(ReferenceData__DataType=np.int32(3)), ("ReferenceData/DataType", "found 3")),
}  # fmt: skip

PARAMS = "params.txt"
LEAP: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "no parameters": (filled(PARAMS, b"hello"), ("0 files of LEAP",)),
    "parameters twice": (lambda p: (p / "b.cfg").write_bytes((p / PARAMS).read_bytes()), ("2 files of LEAP",)),
    "a fan beam": (in_text(PARAMS, "geometry = cone", "geometry = fan"), ("geometry", "'modular'")),
    "a curved panel": (in_text(PARAMS, "tau", "detectorType = curved\ntau"), ("detectorType", "curved")),
    "a helix": (in_text(PARAMS, "helicalPitch = 0.0", "helicalPitch = 2"), ("helicalPitch", "convert_to_modularbeam")),
    "a tilted panel": (in_text(PARAMS, "tiltAngle = 0.0", "tiltAngle = 1"), ("tiltAngle",)),
    "no number of angles": (in_text(PARAMS, "numAngles = 6", "numAngles = none"), ("numAngles", "'none'")),
    "another number of frames": (in_text(PARAMS, "numAngles = 6", "numAngles = 7"), ("(7, 10, 14)",)),
    "too few angles": (in_text(PARAMS, "phis = 100.0, ", "phis = "), ("phis", "5 values")),
    "an angle of text": (in_text(PARAMS, "phis = 100.0", "phis = east"), ("phis", "'east'")),
    "an angle that is NaN": (in_text(PARAMS, "phis = 100.0", "phis = nan"), ("phis", "nan")),
    "a pixel of no size": (in_text(PARAMS, "pixelWidth = 2.5", "pixelWidth = 0"), ("pixelWidth",)),
    "no distance": (in_text(PARAMS, "sdd = 800.0", ""), ("sdd", "nothing")),
    "a huge volume": (in_text(PARAMS, "numZ = 7\nnumY = 9", "numZ = 999999\nnumY = 999999"), ("grid", "at most")),
    "a modular beam without vectors": (in_text(PARAMS, "geometry = cone", "geometry = modular"), ("sourcePositions",)),
    "no frames": (removed("g.npy"), ("no .npy and no TIFF",)), "a truncated array": (truncated("g.npy"), ("damaged .npy",)),
    "an object array": (filled("g.npy", npy_header("(6, 10, 14)", "'|O'")), ("damaged .npy", "object")),
}  # fmt: skip


def tigre(change: Callable[[Any, Path], object] = lambda geo, path: None, **attributes: object) -> Damage:
    """The pickle of a geometry with other attributes."""

    def damage(path: Path) -> None:
        truth = sys.modules["conftest_of_importers"].truth()
        geo = kits.tigre_geometry(truth, **attributes)
        content = change(geo, path) or (truth.scan.projections, geo, truth.angle_rad)
        path.write_bytes(pickle.dumps(content))

    return damage


def tuple_bomb_attribute(path: Path) -> None:
    """DSO is a tuple of a tuple of ..., in a pickle of protocol 4 by hand."""
    name = b"\x8c\x18tigre.utilities.geometry\x94\x8c\x08Geometry\x94\x93\x94)\x81\x94}\x94\x8c\x03DSO"
    path.write_bytes(b"\x80\x04K\x00\x94" + name + doubled(60) + b"sbK\x00\x87.")


TIGRE: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "not a pickle": (filled("", b"tigre.utilities.geometry"), ("damaged pickle",)),
    "a truncated pickle": (truncated("", 0.9), ("damaged pickle",)),
    "a command": (tigre(lambda geo, path: (Bomb(path.parent / "canary"), geo, 0)), ("a call of", "nothing was executed")),
    "a command in the geometry": (
        tigre(lambda geo, path: setattr(geo, "DSO", Bomb(path.parent / "canary"))), ("a call of", "nothing was executed")
    ),
    "another class of TIGRE's": (
        lambda p: p.write_bytes(p.read_bytes().replace(b"\x08Geometry", b"\x08Gpu_xxxx")), ("a call of tigre",)
    ),
    "a dictionary": (tigre(lambda geo, path: {"geometry": geo}), ("projections", "an array of numbers")),
    "no array": (tigre(lambda geo, path: ([1.0], geo, np.zeros(6))), ("projections", "a list of 1")),
    "no angles": (tigre(lambda geo, path: (np.zeros((6, 10, 14)), geo, None)), ("angles",)),
    "another number of angles": (
        tigre(lambda geo, path: (np.zeros((6, 10, 14)), geo, np.zeros(5))), ("projections", "(5, 10, 14)")
    ),
    "a distance of text": (tigre(DSO="far"), ("DSO",)),
    "a distance in lists": (tigre(DSO=[[500.0]]), ("geometry.DSO", "numbers")),
    "no distance": (tigre(DSD=None), ("DSD",)), "a turned panel": (tigre(rotDetector=np.ones(3)), ("rotDetector",)),
    "half a pixel": (tigre(nDetector=np.array([10, 13.5])), ("nDetector",)),
    "a huge grid": (tigre(nVoxel=np.array([10**6] * 3)), ("grid", "at most")),
    "a tuple without end": (tuple_bomb_attribute, ("pickle",)),
}  # fmt: skip
