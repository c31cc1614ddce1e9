"""Every defect of a scan file is one line that names the HDF5 path, and costs no output file."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from damage import attribute, changed, on, put, removed
from damage import value as replaced

from phyradgs_cl.acquisition import CircularOrbit, EncoderTable, PoseTable, Scan
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gating
from phyradgs_cl.io import read_scan, scan_summary, write_scan

DETECTOR, SAMPLE, EXTRA = "/entry/instrument/detector", "/entry/sample", "/entry/phyradgs"
DATA, KEY, MASK = (f"{DETECTOR}/{name}" for name in ("data", "image_key", "pixel_mask"))
ANGLE, GATING = f"{SAMPLE}/rotation_angle", f"{EXTRA}/gating/signal"
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


# by the HDF5 path that a message must name: what happens to a good file there
CASES: dict[str, list[Damage]] = {
    f"{EXTRA}/grid": [renamed("grids")], f"{EXTRA}/kinematics": [renamed("kinematic")],
    "/entry": [removed, entry_misnamed],
    DATA: [
        renamed("Dataa"), changed(lambda d: d[0]), changed(np.float64), changed(np.uint16), poked((2, 1, 3), np.nan),
        attribute("quantity", "counts"),
    ],
    "/away": [soft_link_to_external],
    f"{DATA} @quantity": [lambda f, a: f[a].attrs.pop("quantity"), attribute("quantity", 3.0)],
    KEY: [renamed("imagekey"), changed(lambda k: k[:3]), poked(2, 7), poked(slice(None), 1)],
    f"{DETECTOR}/x_pixel_size": [renamed("x_pixelsize")], f"{DETECTOR}/distance @units": [attribute("units", "s")],
    f"{DETECTOR}/count_time": [poked((), -1), replaced([0.8, 0.8, 0.9, 0.8])],
    f"{DETECTOR}/frame_start_time": [changed(lambda t: t[1:])],
    MASK: [renamed("pixels_mask"), replaced(np.zeros((5, 3), np.uint8)), replaced(np.ones((3, 5), np.uint8))],
    f"{ANGLE} @rotates": [attribute("rotates", "room")], f"{ANGLE}_end": [renamed("rotation_angles_end")],
    f"{EXTRA}/readout_axis": [replaced("diagonal")], f"{EXTRA}/readout_direction": [replaced(2)],
    f"{EXTRA}/detector_offset": [replaced([1.0, 2.0, 3.0])],
    f"{EXTRA}/provenance": [lambda f, a: f.__setitem__(a, "{not json")],
    f"{EXTRA}/grid/shape": [poked(1, 0), changed(np.float64)],
    f"{EXTRA}/reference/volume": [changed(lambda v: v[:, :, 1:])],
    f"{EXTRA}/kinematics/time_s": [
        all_changed(lambda t: t[:-1]), all_changed(lambda t: t[1:]), all_changed(lambda t: t[:1]), poked(4, 0.6),
    ],
    f"{EXTRA}/kinematics/angle_deg": [renamed("angle_degs"), changed(lambda t: t[1:])],
    f"{EXTRA}/poses/pose": [all_changed(lambda t: t[:-1]), changed(lambda p: p[:, 1:]), poked((2, slice(6, 12)), 1.0)],
    GATING: [replaced(np.full(4, np.nan)), replaced(np.zeros(5)), replaced(np.zeros(4, "S4"))],
    f"{EXTRA}/gating/time_s": [
        lambda f, a: f.__setitem__(a, [0.0, 2.0, 1.0, 3.0]), lambda f, a: f.__setitem__(a, np.zeros((4, 1))),
    ],
    f"{EXTRA}/gating/phase": [lambda file, address: file.move(GATING, f"{EXTRA}/gating/phases")],
}


def scan_for(address: str, make_scan: Callable[..., Scan]) -> Scan:
    """A scan that has what is to be damaged: a signal, an encoder's table, one of poses, or all else."""
    mask, time_s = np.arange(15).reshape(3, 5) == 10, np.linspace(0.5, 5.6, 9)
    scan = make_scan(pixel_mask=mask, reference=np.ones((2, 3, 4), np.float32))
    if address.startswith(f"{EXTRA}/gating"):
        return replace(scan, gating=Gating(scan.frame_start_s + scan.shutter.span_s / 2, np.arange(4.0)))
    if address.startswith(f"{EXTRA}/kinematics"):
        table = EncoderTable(time_s, np.linspace(0.1, 1.0, 9))
        return replace(scan, trajectory=CircularOrbit(scan.geometry, table))
    if address.startswith(f"{EXTRA}/poses"):
        return replace(scan, trajectory=PoseTable(time_s, scan.geometry.pose(time_s)))
    return scan


@pytest.fixture
def good(tmp_path, make_scan) -> Path:
    write_scan(tmp_path / "scan.h5", scan_for("", make_scan))
    return tmp_path / "scan.h5"


def refuses(path: Path, address: str, *words: str) -> None:
    with pytest.raises(InputError) as caught:
        read_scan(path, counts_to_attenuation)
    text = str(caught.value)
    assert text.startswith(f"{path}:{address}" if address else f"{path}"), text
    if address:
        rest = caught.value.subject.removeprefix(f"{path}:{address}")
        assert rest == "" or rest.startswith(" ("), text  # a remark, not another path
    assert all(word in text for word in words), text
    assert len(text.splitlines()) == 1 and caught.value.found and caught.value.expected


@pytest.mark.slow
def test_damage_is_named(good, make_scan) -> None:
    contents = {}  # by the group that distinguishes the good scans
    for address, some in CASES.items():
        kind = "/".join(address.split("/")[2:4])
        if kind not in contents:
            write_scan(good, scan_for(address, make_scan))
            assert read_scan(good, counts_to_attenuation).frames == 4
            contents[kind] = good.read_bytes()
        for damage in some:
            good.write_bytes(contents[kind])
            on(address.partition(" @")[0], damage)(good)
            refuses(good, address)
            assert list(good.parent.iterdir()) == [good], address


@pytest.mark.slow
def test_a_spoilt_chunk_is_named(good) -> None:
    on(DATA, lambda file, a: put(file, a, file[a][...], compression="gzip", fletcher32=True))(good)
    with h5py.File(good) as file:
        where = file[DATA].id.get_chunk_info(0)
    with open(good, "r+b") as raw:
        raw.seek(where.byte_offset + where.size // 2)
        raw.write(b"\xff\x00\xff\x00")
    refuses(good, DATA)


def test_damage_is_found_before_the_pixels_are_read(good) -> None:
    on(f"{EXTRA}/detector_model", replaced("linear"))(good)
    for read in (lambda: read_scan(good, lambda *_: pytest.fail("pixels of a bad file")), lambda: scan_summary(good)):
        with pytest.raises(InputError, match="detector_model"):
            read()


@pytest.mark.slow
def test_motion_without_meaning_is_still_said_and_a_mask_that_leaves_flats_alone_named(good, caplog, make_scan) -> None:
    with h5py.File(good, "r+") as file:
        file[f"{SAMPLE}/x_translation"] = np.zeros(4)
    read_scan(good, counts_to_attenuation)
    assert f"{SAMPLE}/x_translation: not read" in caplog.text
    key, data = np.array([1, 0, 0, 0, 0]), np.full((5, 3, 5), 30000, np.uint16)
    write_scan(good, make_scan(), data=data, image_key=key, quantity="counts")
    with h5py.File(good, "r+") as file:
        file[MASK] = np.broadcast_to(key[:, None, None] == 0, data.shape).astype(np.uint8)
    refuses(good, MASK, "every pixel")
