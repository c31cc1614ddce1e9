"""Every defect of a scan file is one line that names the HDF5 path, and costs no output file."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from damage import attribute, changed, put, removed
from damage import value as replaced

from phyradgs_cl.acquisition import CircularOrbit, EncoderTable, PoseTable, Scan
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import read_scan, scan_summary, write_scan

DETECTOR, SAMPLE, EXTRA = "/entry/instrument/detector", "/entry/sample", "/entry/phyradgs"
DATA, KEY, MASK = (f"{DETECTOR}/{name}" for name in ("data", "image_key", "pixel_mask"))
PITCH_V, PITCH_U, DISTANCE = (f"{DETECTOR}/{name}" for name in ("y_pixel_size", "x_pixel_size", "distance"))
EXPOSURE, READOUT = f"{DETECTOR}/count_time", f"{DETECTOR}/detector_readout_time"
START, SOURCE = f"{DETECTOR}/frame_start_time", "/entry/instrument/source/distance"
ANGLE, ANGLE_END = f"{SAMPLE}/rotation_angle", f"{SAMPLE}/rotation_angle_end"
AXIS, DIRECTION, OFFSET = (f"{EXTRA}/{name}" for name in ("readout_axis", "readout_direction", "detector_offset"))
GRID_SHAPE, REFERENCE = f"{EXTRA}/grid/shape", f"{EXTRA}/reference/volume"
Damage = Callable[[h5py.File, str], object]


def renamed(name: str) -> Damage:
    return lambda file, address: file.move(address, f"{os.path.dirname(address)}/{name}")


def all_changed(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    """A table's times and what belongs to them."""

    def damage(file: h5py.File, address: str) -> None:
        group = os.path.dirname(address)
        for name in file[group].keys() & {"time_s", "angle_deg", "pose"}:
            changed(change)(file, f"{group}/{name}")

    return damage


def poked(index: object, value: float) -> Damage:
    return lambda file, address: file[address].__setitem__(index, value)


def soft_link_to_external(file: h5py.File, away: str) -> None:
    file[away] = h5py.ExternalLink("other.h5", "/")
    del file[DATA]
    file[DATA] = h5py.SoftLink(f"{away}/data")


def entry_misnamed(file: h5py.File, address: str) -> None:
    file.move(address, "entrys")
    del file["entrys"].attrs["NX_class"], file["entrys/definition"], file.attrs["default"]


ENCODER_TIME, ENCODER_ANGLE = f"{EXTRA}/kinematics/time_s", f"{EXTRA}/kinematics/angle_deg"
POSE = f"{EXTRA}/poses/pose"
RENAMED = {
    DATA: "Dataa", KEY: "imagekey", PITCH_U: "x_pixelsize", MASK: "pixels_mask",
    ANGLE_END: "rotation_angles_end",
    f"{EXTRA}/grid": "grids", ENCODER_ANGLE: "angle_degs", f"{EXTRA}/kinematics": "kinematic",
}  # fmt: skip
# name: (the HDF5 path that the message must name, what happens to a good file there, words that the message must hold)
CASES: dict[str, tuple[Any, ...]] = {
    **{
        f"{address} misnamed": (address, renamed(name), f"rename '{name}'")
        for address, name in RENAMED.items()
    },
    "no entry": ("/entry", removed, "NXentry"),
    "entry misnamed": ("/entry", entry_misnamed, "rename 'entrys'"),
    "data 2D": (DATA, changed(lambda d: d[0]), "(3, 5)", "three axes"),
    "data float64": (DATA, changed(np.float64), "float64", "float32"),
    "data int32": (DATA, changed(np.int32), "int32", "uint16"),
    "data uint16 attenuation": (DATA, changed(np.uint16), "uint16", "float32"),
    "data NaN": (DATA, poked((2, 1, 3), np.nan), "frame 2 at (1, 3)", "pixel_mask"),
    "soft link to elsewhere": ("/away", soft_link_to_external, "other.h5"),
    "no quantity": (f"{DATA} @quantity", lambda f, a: f[a].attrs.pop("quantity"), "attenuation"),
    "unknown quantity": (f"{DATA} @quantity", attribute("quantity", "HU"), "'HU'"),
    "quantity a number": (f"{DATA} @quantity", attribute("quantity", 3.0), "a string"),
    "counts without flats": (DATA, attribute("quantity", "counts"), "flat"),
    "image_key short": (KEY, changed(lambda k: k[:3]), "(3,)", "(4)"),
    "image_key unknown": (KEY, poked(2, 7), "7 at index 2"),
    "no projections": (KEY, poked(slice(None), 1), "no projection"),
    "pixel size negative": (PITCH_V, poked((), -0.5), "-0.5", "above 0"),
    "pixel size zero": (PITCH_U, poked((), 0), "above 0"),
    "unit of time for a length": (f"{DISTANCE} @units", attribute("units", "s"), "mm"),
    "source at the axis": (SOURCE, poked((), 0), "0"),
    "exposure negative": (EXPOSURE, poked((), -1), "-1 s"),
    "exposure varies": (EXPOSURE, replaced([0.8, 0.8, 0.9, 0.8]), "0.8 to 0.9 s", "one time"),
    "exposure in degrees": (f"{EXPOSURE} @units", attribute("units", "deg"), "ms"),
    "readout negative": (READOUT, poked((), -1), "-1 s"),
    "start times short": (START, changed(lambda t: t[1:]), "(3,)", "(4)"),
    "mask of another shape": (MASK, replaced(np.zeros((5, 3), np.uint8)), "(5, 3)", "(3, 5)"),
    "mask of everything": (MASK, replaced(np.ones((3, 5), np.uint8)), "every pixel"),
    "angle unit": (f"{ANGLE} @units", attribute("units", "gon"), "deg", "rad"),
    "end angles short": (ANGLE_END, changed(lambda a: a[:2]), "(2,)"),
    "what rotates": (f"{ANGLE} @rotates", attribute("rotates", "room"), "'room'"),
    "readout axis": (AXIS, replaced("diagonal"), "'diagonal'", "'rows'"),
    "readout direction": (DIRECTION, replaced(2), "2", "-1"),
    "detector model": (f"{EXTRA}/detector_model", replaced("linear"), "'linear'", "'log'"),
    "offset of three": (OFFSET, replaced([1.0, 2.0, 3.0]), "(3,)", "(2)"),
    "provenance": (f"{EXTRA}/provenance", lambda f, a: f.__setitem__(a, "{not json"), "JSON"),
    "grid shape zero": (GRID_SHAPE, poked(1, 0), "[2, 0, 4]"),
    "grid shape of floats": (GRID_SHAPE, changed(np.float64), "whole numbers"),
    "grid voxels negative": (f"{EXTRA}/grid/voxel_size", poked(0, -1), "above 0"),
    "reference of another shape": (REFERENCE, changed(lambda v: v[:, :, 1:]), "(2, 3, 3)", "(2, 3, 4)"),
    "reference unit": (f"{REFERENCE} @units", attribute("units", "HU"), "1/cm"),
    "encoder too short": (
        ENCODER_TIME, all_changed(lambda t: t[:-1]), "frame 3 needs 4.5 to 5.6 s", "extend the table",
    ),
    "encoder starts late": (ENCODER_TIME, all_changed(lambda t: t[1:]), "frame 0 needs 0.5"),
    "encoder lengths": (ENCODER_ANGLE, changed(lambda t: t[1:]), "(8,)", "(9)"),
    "encoder goes back": (ENCODER_TIME, poked(4, 0.6), "index 4", "increasing"),
    "encoder of one": (ENCODER_TIME, all_changed(lambda t: t[:1]), "1 samples"),
    "pose table too short": (POSE, all_changed(lambda t: t[:-1]), "frame 3 needs"),
    "poses of eleven numbers": (POSE, changed(lambda p: p[:, 1:]), "(9, 11)", "(9, 12)"),
    "pose without plane": (POSE, poked((2, slice(6, 12)), 1.0), "parallel"),
}


def scan_for(address: str, make_scan: Callable[..., Scan]) -> Scan:
    """A scan that has what is to be damaged: an encoder's table, one of poses, or all else."""
    mask, time_s = np.arange(15).reshape(3, 5) == 10, np.linspace(0.5, 5.6, 9)
    scan = make_scan(pixel_mask=mask, reference=np.ones((2, 3, 4), np.float32))
    if address.startswith(f"{EXTRA}/kinematics"):
        return replace(
            scan, trajectory=CircularOrbit(scan.geometry, EncoderTable(time_s, np.linspace(0.1, 1.0, 9)))
        )
    if address.startswith(f"{EXTRA}/poses"):
        return replace(scan, trajectory=PoseTable(time_s, scan.geometry.pose(time_s)))
    return scan


@pytest.fixture
def good(tmp_path, make_scan) -> Path:
    write_scan(tmp_path / "scan.h5", scan_for("", make_scan))
    return tmp_path / "scan.h5"


def refuses(path: Path, address: str, words: Sequence[str]) -> None:
    with pytest.raises(InputError) as caught:
        read_scan(path, counts_to_attenuation)
    text = str(caught.value)
    assert text.startswith(f"{path}:{address}" if address else f"{path}"), text
    if address:
        rest = caught.value.subject.removeprefix(f"{path}:{address}")
        assert rest == "" or rest.startswith(" ("), text  # a remark, not another path
    assert all(word in text for word in words), text
    assert len(text.splitlines()) == 1
    assert caught.value.found and caught.value.expected


@pytest.mark.slow
def test_damage_is_named(good, make_scan) -> None:
    for case, (address, damage, *words) in CASES.items():
        write_scan(good, scan_for(address, make_scan))
        assert read_scan(good, counts_to_attenuation).frames == 4
        with h5py.File(good, "r+") as file:
            damage(file, address.partition(" @")[0])
        before = sorted(good.parent.iterdir())
        refuses(good, address, words)
        assert sorted(good.parent.iterdir()) == before, case


@pytest.mark.slow
def test_whole_files_that_are_wrong(tmp_path, good) -> None:
    content = good.read_bytes()
    (tmp_path / "text.h5").write_text("not HDF5 at all\n" * 100)
    (tmp_path / "empty.h5").write_bytes(b"")
    (tmp_path / "half.h5").write_bytes(content[: len(content) // 2])
    (tmp_path / "noise.h5").write_bytes(content[:8] + bytes(range(256)) * 20)
    words = {"missing.h5": "no such file", "": "a folder", "text.h5": "not HDF5", "empty.h5": "HDF5"}
    words |= {"half.h5": "truncated", "noise.h5": "HDF5"}
    for name, word in words.items():
        with pytest.raises(InputError) as caught:
            read_scan(tmp_path / name, counts_to_attenuation)
        assert str(tmp_path / name) in str(caught.value) and word in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_file_that_may_not_be_read(good, monkeypatch) -> None:
    """The superuser may read any: the system's answer is put in its place."""
    monkeypatch.setattr(os, "access", lambda path, mode: not (mode & os.R_OK and Path(path) == good))
    refuses(good, "", ("no permission to read it", "whoever owns"))


@pytest.mark.slow
def test_a_spoilt_chunk_is_named(tmp_path, good) -> None:
    with h5py.File(good, "r+") as file:
        put(file, DATA, file[DATA][...], compression="gzip", fletcher32=True)
    with h5py.File(good) as file:
        where = file[DATA].id.get_chunk_info(0)
    with open(good, "r+b") as raw:
        raw.seek(where.byte_offset + where.size // 2)
        raw.write(b"\xff\x00\xff\x00")
    refuses(good, DATA, ("cannot read",))


def test_damage_is_found_before_the_pixels_are_read(good) -> None:
    with h5py.File(good, "r+") as file:
        replaced("linear")(file, f"{EXTRA}/detector_model")
    for read in (
        lambda: read_scan(good, lambda *_: pytest.fail("pixels of a bad file")), lambda: scan_summary(good),
    ):
        with pytest.raises(InputError, match="detector_model"):
            read()


@pytest.mark.slow
def test_motion_without_meaning_is_still_said(good, caplog) -> None:
    with h5py.File(good, "r+") as file:
        file[f"{SAMPLE}/x_translation"] = np.zeros(4)
    read_scan(good, counts_to_attenuation)
    assert f"{SAMPLE}/x_translation: not read" in caplog.text


@pytest.mark.slow
def test_a_mask_of_all_projections_is_named_though_a_flat_is_free(tmp_path, make_scan) -> None:
    scan, path = make_scan(), tmp_path / "scan.h5"
    data = np.concatenate([np.full((1, 3, 5), 60000), np.full((4, 3, 5), 30000)]).astype(np.uint16)
    write_scan(path, scan, data=data, image_key=np.array([1, 0, 0, 0, 0]), quantity="counts")
    mask = np.ones((5, 3, 5), np.uint8)
    mask[0] = 0
    with h5py.File(path, "r+") as file:
        file[MASK] = mask
    refuses(path, MASK, ("every pixel",))
