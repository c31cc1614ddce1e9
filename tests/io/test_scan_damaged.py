"""Every defect of a scan file is one line that names the HDF5 path, and costs no output file."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, EncoderTable, PoseTable
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import read_scan, scan_summary, write_scan

DETECTOR, SAMPLE, EXTRA = "/entry/instrument/detector", "/entry/sample", "/entry/phyradgs"
Damage = Callable[[h5py.File], None]


def deleted(address: str) -> Damage:
    def damage(file: h5py.File) -> None:
        del file[address]

    return damage


def renamed(address: str, name: str) -> Damage:
    return lambda file: file.move(address, f"{os.path.dirname(address)}/{name}")


def replaced(address: str, value: object, dtype: object = None) -> Damage:
    """Other content under the same attributes."""

    def damage(file: h5py.File) -> None:
        attributes = dict(file[address].attrs)
        del file[address]
        file.create_dataset(address, data=value, dtype=dtype).attrs.update(attributes)

    return damage


def changed(address: str, change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    return lambda file: replaced(address, change(file[address][()]))(file)


def poked(address: str, index: object, value: float) -> Damage:
    def damage(file: h5py.File) -> None:
        file[address][index] = value

    return damage


def attribute(address: str, name: str, value: object) -> Damage:
    def damage(file: h5py.File) -> None:
        file[address].attrs[name] = value

    return damage


def linked(address: str, link: object) -> Damage:
    def damage(file: h5py.File) -> None:
        del file[address]
        file[address] = link

    return damage


def group_instead(address: str) -> Damage:
    def damage(file: h5py.File) -> None:
        del file[address]
        file.create_group(address)

    return damage


def external_storage(file: h5py.File) -> None:
    raw = Path(file.filename).with_suffix(".raw")
    np.zeros((4, 3, 5), np.float32).tofile(raw)
    del file[f"{DETECTOR}/data"]
    made = file.create_dataset(
        f"{DETECTOR}/data", (4, 3, 5), "f4", external=[(str(raw), 0, h5py.h5f.UNLIMITED)]
    )
    made.attrs["quantity"] = "attenuation"


def virtual_dataset(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((4, 3, 5), "f4")
    layout[:] = h5py.VirtualSource("other.h5", "data", (4, 3, 5))
    del file[f"{DETECTOR}/data"]
    file.create_virtual_dataset(f"{DETECTOR}/data", layout).attrs["quantity"] = "attenuation"


def huge(chunks: object) -> Damage:
    def damage(file: h5py.File) -> None:
        del file[f"{DETECTOR}/data"]
        shape = (4, 100_000, 200_000)
        space = {"chunks": chunks} if chunks else {}
        made = file.create_dataset(f"{DETECTOR}/data", shape, "f4", **space)
        made.attrs["quantity"] = "attenuation"

    return damage


def soft_loop(file: h5py.File) -> None:
    del file[f"{DETECTOR}/data"]
    file[f"{DETECTOR}/data"] = h5py.SoftLink("/loop")
    file["/loop"] = h5py.SoftLink(f"{DETECTOR}/data")


def soft_link_to_external(file: h5py.File) -> None:
    file["/away"] = h5py.ExternalLink("other.h5", "/")
    linked(f"{DETECTOR}/data", h5py.SoftLink("/away/data"))(file)


def null_dataset(file: h5py.File) -> None:
    del file[f"{DETECTOR}/distance"]
    file[f"{DETECTOR}/distance"] = h5py.Empty("f8")


# name: (what happens to a good file, the HDF5 path that the message must name, words that it must hold)
CASES: dict[str, tuple[Damage, str, tuple[str, ...]]] = {
    "no entry": (deleted("/entry"), "/entry", ("NXentry",)),
    "entry misnamed": (
        lambda f: (f.move("entry", "entrys"), f["entrys"].attrs.pop("NX_class"), f.attrs.pop("default")),
        "/entry",
        ("rename 'entrys'",),
    ),
    "no instrument": (deleted("/entry/instrument"), "/entry/instrument", ("nothing there",)),
    "no data": (deleted(f"{DETECTOR}/data"), f"{DETECTOR}/data", ("nothing there", "add it")),
    "data misnamed": (
        renamed(f"{DETECTOR}/data", "Dataa"),
        f"{DETECTOR}/data",
        ("rename 'Dataa' to 'data'",),
    ),
    "data is a group": (group_instead(f"{DETECTOR}/data"), f"{DETECTOR}/data", ("a group",)),
    "data 2D": (changed(f"{DETECTOR}/data", lambda d: d[0]), f"{DETECTOR}/data", ("(3, 5)", "three axes")),
    "data empty": (changed(f"{DETECTOR}/data", lambda d: d[:0]), f"{DETECTOR}/data", ("(0, 3, 5)",)),
    "data float64": (changed(f"{DETECTOR}/data", np.float64), f"{DETECTOR}/data", ("float64", "float32")),
    "data int32": (changed(f"{DETECTOR}/data", np.int32), f"{DETECTOR}/data", ("int32", "uint16")),
    "data complex": (changed(f"{DETECTOR}/data", np.complex64), f"{DETECTOR}/data", ("complex64",)),
    "data uint16 attenuation": (
        changed(f"{DETECTOR}/data", np.uint16),
        f"{DETECTOR}/data",
        ("uint16", "float32"),
    ),
    "data NaN": (
        poked(f"{DETECTOR}/data", (2, 1, 3), np.nan),
        f"{DETECTOR}/data",
        ("frame 2 at (1, 3)", "pixel_mask"),
    ),
    "data infinite": (
        poked(f"{DETECTOR}/data", (0, 0, 0), np.inf),
        f"{DETECTOR}/data",
        ("frame 0 at (0, 0)",),
    ),
    "data elsewhere": (
        linked(f"{DETECTOR}/data", h5py.ExternalLink("other.h5", "/data")),
        f"{DETECTOR}/data",
        ("other.h5",),
    ),
    "detector elsewhere": (linked(DETECTOR, h5py.ExternalLink("other.h5", "/d")), DETECTOR, ("other.h5",)),
    "soft link to elsewhere": (soft_link_to_external, "/away", ("other.h5",)),
    "soft link to nothing": (
        linked(f"{DETECTOR}/data", h5py.SoftLink("/gone")),
        f"{DETECTOR}/data",
        ("nothing there",),
    ),
    "soft link loop": (soft_loop, "", ("loop of links",)),
    "data in a raw file": (external_storage, f"{DETECTOR}/data", ("other files",)),
    "data virtual": (virtual_dataset, f"{DETECTOR}/data", ("other files",)),
    "data declared huge": (huge(None), f"{DETECTOR}/data", ("298 GiB", "hold")),
    "data declared huge in chunks": (huge((1, 1000, 1000)), f"{DETECTOR}/data", ("298 GiB", "hold")),
    "no quantity": (
        lambda f: f[f"{DETECTOR}/data"].attrs.pop("quantity"),
        f"{DETECTOR}/data @quantity",
        ("attenuation",),
    ),
    "unknown quantity": (
        attribute(f"{DETECTOR}/data", "quantity", "HU"),
        f"{DETECTOR}/data @quantity",
        ("'HU'",),
    ),
    "quantity a number": (
        attribute(f"{DETECTOR}/data", "quantity", 3.0),
        f"{DETECTOR}/data @quantity",
        ("a string",),
    ),
    "counts without flats": (
        attribute(f"{DETECTOR}/data", "quantity", "counts"),
        f"{DETECTOR}/data",
        ("flat",),
    ),
    "no image_key": (deleted(f"{DETECTOR}/image_key"), f"{DETECTOR}/image_key", ("nothing there",)),
    "image_key misnamed": (
        renamed(f"{DETECTOR}/image_key", "imagekey"),
        f"{DETECTOR}/image_key",
        ("rename 'imagekey'",),
    ),
    "image_key short": (
        changed(f"{DETECTOR}/image_key", lambda k: k[:3]),
        f"{DETECTOR}/image_key",
        ("(3,)", "(4)"),
    ),
    "image_key of floats": (
        changed(f"{DETECTOR}/image_key", np.float64),
        f"{DETECTOR}/image_key",
        ("float64", "whole"),
    ),
    "image_key unknown": (poked(f"{DETECTOR}/image_key", 2, 7), f"{DETECTOR}/image_key", ("7 at index 2",)),
    "no projections": (
        poked(f"{DETECTOR}/image_key", slice(None), 1),
        f"{DETECTOR}/image_key",
        ("no projection",),
    ),
    "no pixel size": (deleted(f"{DETECTOR}/x_pixel_size"), f"{DETECTOR}/x_pixel_size", ("nothing there",)),
    "pixel size misnamed": (
        renamed(f"{DETECTOR}/x_pixel_size", "x_pixelsize"),
        f"{DETECTOR}/x_pixel_size",
        ("rename 'x_pixelsize'",),
    ),
    "pixel size negative": (
        poked(f"{DETECTOR}/y_pixel_size", (), -0.5),
        f"{DETECTOR}/y_pixel_size",
        ("-0.5", "above 0"),
    ),
    "pixel size zero": (poked(f"{DETECTOR}/x_pixel_size", (), 0), f"{DETECTOR}/x_pixel_size", ("above 0",)),
    "pixel size NaN": (poked(f"{DETECTOR}/x_pixel_size", (), np.nan), f"{DETECTOR}/x_pixel_size", ("NaN",)),
    "pixel size two numbers": (
        replaced(f"{DETECTOR}/x_pixel_size", [1.0, 2.0]),
        f"{DETECTOR}/x_pixel_size",
        ("(2,)",),
    ),
    "pixel size text": (
        replaced(f"{DETECTOR}/x_pixel_size", "0.5"),
        f"{DETECTOR}/x_pixel_size",
        ("numbers",),
    ),
    "unknown unit": (
        attribute(f"{DETECTOR}/distance", "units", "furlong"),
        f"{DETECTOR}/distance @units",
        ("'furlong'", "cm"),
    ),
    "unit of time for a length": (
        attribute(f"{DETECTOR}/distance", "units", "s"),
        f"{DETECTOR}/distance @units",
        ("mm",),
    ),
    "no detector distance": (deleted(f"{DETECTOR}/distance"), f"{DETECTOR}/distance", ("nothing there",)),
    "detector distance negative": (
        poked(f"{DETECTOR}/distance", (), -1),
        f"{DETECTOR}/distance",
        ("above 0",),
    ),
    "distance without value": (null_dataset, f"{DETECTOR}/distance", ("empty",)),
    "no source": (deleted("/entry/instrument/source"), "/entry/instrument/source", ("nothing there",)),
    "source at the axis": (
        poked("/entry/instrument/source/distance", (), 0),
        "/entry/instrument/source/distance",
        ("0",),
    ),
    "no exposure": (deleted(f"{DETECTOR}/count_time"), f"{DETECTOR}/count_time", ("nothing there",)),
    "exposure negative": (poked(f"{DETECTOR}/count_time", (), -1), f"{DETECTOR}/count_time", ("-1 s",)),
    "exposure varies": (
        replaced(f"{DETECTOR}/count_time", [0.8, 0.8, 0.9, 0.8]),
        f"{DETECTOR}/count_time",
        ("0.8 to 0.9 s", "one time"),
    ),
    "exposure in degrees": (
        attribute(f"{DETECTOR}/count_time", "units", "deg"),
        f"{DETECTOR}/count_time @units",
        ("ms",),
    ),
    "no readout time": (
        deleted(f"{DETECTOR}/detector_readout_time"),
        f"{DETECTOR}/detector_readout_time",
        ("nothing",),
    ),
    "readout negative": (
        poked(f"{DETECTOR}/detector_readout_time", (), -1),
        f"{DETECTOR}/detector_readout_time",
        ("-1 s",),
    ),
    "no start times": (
        deleted(f"{DETECTOR}/frame_start_time"),
        f"{DETECTOR}/frame_start_time",
        ("nothing there",),
    ),
    "start times short": (
        changed(f"{DETECTOR}/frame_start_time", lambda t: t[1:]),
        f"{DETECTOR}/frame_start_time",
        ("(3,)", "(4)"),
    ),
    "start time NaN": (
        poked(f"{DETECTOR}/frame_start_time", 1, np.nan),
        f"{DETECTOR}/frame_start_time",
        ("first at (1,)",),
    ),
    "mask of another shape": (
        replaced(f"{DETECTOR}/pixel_mask", np.zeros((5, 3), np.uint8)),
        f"{DETECTOR}/pixel_mask",
        ("(5, 3)", "(3, 5)"),
    ),
    "mask of floats": (
        replaced(f"{DETECTOR}/pixel_mask", np.zeros((3, 5))),
        f"{DETECTOR}/pixel_mask",
        ("float64",),
    ),
    "mask of everything": (
        replaced(f"{DETECTOR}/pixel_mask", np.ones((3, 5), np.uint8)),
        f"{DETECTOR}/pixel_mask",
        ("every pixel",),
    ),
    "mask misnamed": (
        renamed(f"{DETECTOR}/pixel_mask", "pixels_mask"),
        f"{DETECTOR}/pixel_mask",
        ("rename 'pixels_mask'",),
    ),
    "no angles": (deleted(f"{SAMPLE}/rotation_angle"), f"{SAMPLE}/rotation_angle", ("nothing there",)),
    "angles 2D": (
        changed(f"{SAMPLE}/rotation_angle", lambda a: a[None]),
        f"{SAMPLE}/rotation_angle",
        ("(1, 4)",),
    ),
    "angle NaN": (
        poked(f"{SAMPLE}/rotation_angle", 3, np.nan),
        f"{SAMPLE}/rotation_angle",
        ("first at (3,)",),
    ),
    "angle unit": (
        attribute(f"{SAMPLE}/rotation_angle", "units", "gon"),
        f"{SAMPLE}/rotation_angle @units",
        ("deg, rad",),
    ),
    "end angles misnamed": (
        renamed(f"{SAMPLE}/rotation_angle_end", "rotation_angles_end"),
        f"{SAMPLE}/rotation_angle_end",
        ("rename",),
    ),
    "end angles short": (
        changed(f"{SAMPLE}/rotation_angle_end", lambda a: a[:2]),
        f"{SAMPLE}/rotation_angle_end",
        ("(2,)",),
    ),
    "what rotates": (
        attribute(f"{SAMPLE}/rotation_angle", "rotates", "room"),
        f"{SAMPLE}/rotation_angle @rotates",
        ("'room'",),
    ),
    "no readout axis": (deleted(f"{EXTRA}/readout_axis"), f"{EXTRA}/readout_axis", ("nothing there",)),
    "readout axis": (
        replaced(f"{EXTRA}/readout_axis", "diagonal"),
        f"{EXTRA}/readout_axis",
        ("'diagonal'", "'rows'"),
    ),
    "readout axis a number": (replaced(f"{EXTRA}/readout_axis", 1), f"{EXTRA}/readout_axis", ("a string",)),
    "readout direction": (
        replaced(f"{EXTRA}/readout_direction", 2),
        f"{EXTRA}/readout_direction",
        ("2", "-1"),
    ),
    "readout direction between": (
        replaced(f"{EXTRA}/readout_direction", 1.5),
        f"{EXTRA}/readout_direction",
        ("1.5",),
    ),
    "detector model": (
        replaced(f"{EXTRA}/detector_model", "linear"),
        f"{EXTRA}/detector_model",
        ("'linear'", "'log'"),
    ),
    "offset of three": (
        replaced(f"{EXTRA}/detector_offset", [1.0, 2.0, 3.0]),
        f"{EXTRA}/detector_offset",
        ("(3,)", "(2)"),
    ),
    "offset infinite": (
        poked(f"{EXTRA}/detector_offset", 0, np.inf),
        f"{EXTRA}/detector_offset",
        ("infinite",),
    ),
    "provenance": (
        lambda f: f[EXTRA].__setitem__("provenance", "{not json"),
        f"{EXTRA}/provenance",
        ("JSON",),
    ),
    "grid without shape": (deleted(f"{EXTRA}/grid/shape"), f"{EXTRA}/grid/shape", ("nothing there",)),
    "grid shape zero": (poked(f"{EXTRA}/grid/shape", 1, 0), f"{EXTRA}/grid/shape", ("[2, 0, 4]",)),
    "grid shape of floats": (
        changed(f"{EXTRA}/grid/shape", np.float64),
        f"{EXTRA}/grid/shape",
        ("whole numbers",),
    ),
    "grid voxels negative": (
        poked(f"{EXTRA}/grid/voxel_size", 0, -1),
        f"{EXTRA}/grid/voxel_size",
        ("above 0",),
    ),
    "grid misnamed": (renamed(f"{EXTRA}/grid", "grids"), f"{EXTRA}/grid", ("rename 'grids'",)),
    "reference of another shape": (
        changed(f"{EXTRA}/reference/volume", lambda v: v[:, :, 1:]),
        f"{EXTRA}/reference/volume",
        ("(2, 3, 3)", "(2, 3, 4)"),
    ),
    "reference NaN": (
        poked(f"{EXTRA}/reference/volume", (0, 1, 2), np.nan),
        f"{EXTRA}/reference/volume",
        ("(0, 1, 2)",),
    ),
    "reference unit": (
        attribute(f"{EXTRA}/reference/volume", "units", "HU"),
        f"{EXTRA}/reference/volume @units",
        ("1/cm",),
    ),
    "reference without volume": (
        deleted(f"{EXTRA}/reference/volume"),
        f"{EXTRA}/reference/volume",
        ("nothing",),
    ),
    "title a number": (replaced("/entry/title", 3), "/entry/title", ("a string",)),
}


@pytest.fixture
def good(tmp_path, make_scan) -> Path:
    mask = np.zeros((3, 5), bool)
    mask[2, 0] = True
    write_scan(tmp_path / "scan.h5", make_scan(pixel_mask=mask, reference=np.ones((2, 3, 4), np.float32)))
    return tmp_path / "scan.h5"


def refuses(path: Path, address: str, words: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as caught:
        read_scan(path, counts_to_attenuation)
    text = str(caught.value)
    assert text.startswith(f"{path}:{address}" if address else f"{path}"), text
    if address:
        rest = caught.value.culprit.removeprefix(f"{path}:{address}")
        assert rest == "" or rest.startswith(" ("), text  # a remark, not another path
    assert all(word in text for word in words), text
    assert len(text.splitlines()) == 1
    assert caught.value.found and caught.value.expected


def test_the_file_is_good_before_the_damage(good) -> None:
    assert read_scan(good, counts_to_attenuation).frames == 4


@pytest.mark.parametrize("case", CASES)
def test_damage_is_named(good, case) -> None:
    damage, address, words = CASES[case]
    with h5py.File(good, "r+") as file:
        damage(file)
    before = sorted(good.parent.iterdir())
    refuses(good, address, words)
    assert sorted(good.parent.iterdir()) == before


def encoder_scan(make_scan):
    scan = make_scan()
    table = EncoderTable(np.linspace(0.5, 5.6, 9), np.linspace(0.1, 1.0, 9))
    return dataclasses.replace(scan, trajectory=CircularOrbit(scan.geometry, table))


def pose_scan(make_scan):
    scan = make_scan()
    time_s = np.linspace(0.5, 5.6, 9)
    return dataclasses.replace(scan, trajectory=PoseTable(time_s, scan.geometry.pose(time_s)))


TABLES: dict[str, tuple[Callable, Damage, str, tuple[str, ...]]] = {
    "encoder too short": (
        encoder_scan,
        lambda f: [changed(f"{EXTRA}/kinematics/{n}", lambda t: t[:-1])(f) for n in ("time_s", "angle_deg")],
        f"{EXTRA}/kinematics/time_s",
        ("frame 3 needs 4.5 to 5.6 s", "extend the table"),
    ),
    "encoder starts late": (
        encoder_scan,
        lambda f: [changed(f"{EXTRA}/kinematics/{n}", lambda t: t[1:])(f) for n in ("time_s", "angle_deg")],
        f"{EXTRA}/kinematics/time_s",
        ("frame 0 needs 0.5",),
    ),
    "encoder lengths": (
        encoder_scan,
        changed(f"{EXTRA}/kinematics/angle_deg", lambda t: t[1:]),
        f"{EXTRA}/kinematics/angle_deg",
        ("(8,)", "(9)"),
    ),
    "encoder goes back": (
        encoder_scan,
        poked(f"{EXTRA}/kinematics/time_s", 4, 0.6),
        f"{EXTRA}/kinematics/time_s",
        ("index 4", "increasing"),
    ),
    "encoder NaN": (
        encoder_scan,
        poked(f"{EXTRA}/kinematics/angle_deg", 5, np.nan),
        f"{EXTRA}/kinematics/angle_deg",
        ("first at (5,)",),
    ),
    "encoder misnamed": (
        encoder_scan,
        renamed(f"{EXTRA}/kinematics/angle_deg", "angle_degs"),
        f"{EXTRA}/kinematics/angle_deg",
        ("rename 'angle_degs'",),
    ),
    "encoder group misnamed": (
        encoder_scan,
        renamed(f"{EXTRA}/kinematics", "kinematic"),
        f"{EXTRA}/kinematics",
        ("rename 'kinematic'",),
    ),
    "encoder group a dataset": (
        encoder_scan,
        replaced(f"{EXTRA}/kinematics", 1.0),
        f"{EXTRA}/kinematics",
        ("a dataset", "a group"),
    ),
    "encoder of one": (
        encoder_scan,
        lambda f: [changed(f"{EXTRA}/kinematics/{n}", lambda t: t[:1])(f) for n in ("time_s", "angle_deg")],
        f"{EXTRA}/kinematics/time_s",
        ("1 samples",),
    ),
    "pose table too short": (
        pose_scan,
        lambda f: [changed(f"{EXTRA}/poses/{n}", lambda t: t[:-1])(f) for n in ("time_s", "pose")],
        f"{EXTRA}/poses/",
        ("frame 3 needs",),
    ),
    "poses of eleven numbers": (
        pose_scan,
        changed(f"{EXTRA}/poses/pose", lambda p: p[:, 1:]),
        f"{EXTRA}/poses/pose",
        ("(9, 11)", "(9, 12)"),
    ),
    "pose infinite": (
        pose_scan,
        poked(f"{EXTRA}/poses/pose", (3, 2), np.inf),
        f"{EXTRA}/poses/pose",
        ("(3, 2)",),
    ),
    "pose without plane": (
        pose_scan,
        poked(f"{EXTRA}/poses/pose", (2, slice(6, 12)), 1.0),
        f"{EXTRA}/poses/pose",
        ("parallel",),
    ),
    "no pose times": (
        pose_scan,
        deleted(f"{EXTRA}/poses/time_s"),
        f"{EXTRA}/poses/time_s",
        ("nothing there",),
    ),
}


@pytest.mark.parametrize("case", TABLES)
def test_damaged_tables_are_named(tmp_path, make_scan, case) -> None:
    make, damage, address, words = TABLES[case]
    path = tmp_path / "scan.h5"
    write_scan(path, make(make_scan))
    read_scan(path, counts_to_attenuation)
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(InputError) as caught:
        read_scan(path, counts_to_attenuation)
    text = str(caught.value)
    assert caught.value.culprit.startswith(f"{path}:{address}"), text
    assert all(word in text for word in words), text
    assert "\n" not in text


def test_whole_files_that_are_wrong(tmp_path, good) -> None:
    content = good.read_bytes()
    (tmp_path / "text.h5").write_text("not HDF5 at all\n" * 100)
    (tmp_path / "empty.h5").write_bytes(b"")
    (tmp_path / "half.h5").write_bytes(content[: len(content) // 2])
    (tmp_path / "noise.h5").write_bytes(content[:8] + bytes(range(256)) * 20)
    words = {
        "missing.h5": "no such file",
        "": "a folder",
        "text.h5": "not HDF5",
        "empty.h5": "HDF5",
        "half.h5": "truncated",
        "noise.h5": "HDF5",
    }
    for name, word in words.items():
        with pytest.raises(InputError) as caught:
            read_scan(tmp_path / name, counts_to_attenuation)
        assert str(tmp_path / name) in str(caught.value) and word in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_spoilt_chunk_is_named(tmp_path, good) -> None:
    with h5py.File(good, "r+") as file:
        frames = file[f"{DETECTOR}/data"][...]
        del file[f"{DETECTOR}/data"]
        made = file.create_dataset(f"{DETECTOR}/data", data=frames, compression="gzip", fletcher32=True)
        made.attrs["quantity"] = "attenuation"
    with h5py.File(good) as file:
        where = file[f"{DETECTOR}/data"].id.get_chunk_info(0)
    with open(good, "r+b") as raw:
        raw.seek(where.byte_offset + where.size // 2)
        raw.write(b"\xff\x00\xff\x00")
    refuses(good, f"{DETECTOR}/data", ("cannot read",))


def test_every_cut_of_a_file_is_refused_or_read(good, tmp_path) -> None:
    content = good.read_bytes()
    for size in range(0, len(content), max(1, len(content) // 60)):
        (tmp_path / "cut.h5").write_bytes(content[:size])
        with pytest.raises(InputError):
            read_scan(tmp_path / "cut.h5", counts_to_attenuation)


def test_no_flipped_byte_escapes_as_another_error(good, tmp_path) -> None:
    content, rng = bytearray(good.read_bytes()), np.random.default_rng(0)
    refused = 0
    for position in rng.integers(0, min(len(content), 20_000), 100):
        spoilt = bytearray(content)
        spoilt[position] ^= 1 << int(rng.integers(8))
        (tmp_path / "flip.h5").write_bytes(spoilt)
        try:
            read_scan(tmp_path / "flip.h5", counts_to_attenuation)
        except InputError:
            refused += 1
    assert refused > 5


def test_damage_is_found_before_the_pixels_are_read(good) -> None:
    with h5py.File(good, "r+") as file:
        replaced(f"{EXTRA}/detector_model", "linear")(file)

    def never(*_: object) -> None:
        raise AssertionError("converted pixels of a bad file")

    with pytest.raises(InputError, match="detector_model"):
        read_scan(good, never)
    with pytest.raises(InputError, match="detector_model"):
        scan_summary(good)


def test_motion_without_meaning_is_still_said(good, caplog) -> None:
    with h5py.File(good, "r+") as file:
        file[f"{SAMPLE}/x_translation"] = np.zeros(4)
    read_scan(good, counts_to_attenuation)
    assert f"{SAMPLE}/x_translation: not read" in caplog.text


def test_a_mask_of_all_projections_is_named_though_a_flat_is_free(tmp_path, make_scan) -> None:
    scan, path = make_scan(), tmp_path / "scan.h5"
    data = np.concatenate([np.full((1, 3, 5), 60000), np.full((4, 3, 5), 30000)]).astype(np.uint16)
    write_scan(path, scan, data=data, image_key=np.array([1, 0, 0, 0, 0]), quantity="counts")
    mask = np.ones((5, 3, 5), np.uint8)
    mask[0] = 0
    with h5py.File(path, "r+") as file:
        file[f"{DETECTOR}/pixel_mask"] = mask
    refuses(path, f"{DETECTOR}/pixel_mask", ("every pixel",))
