"""Scans and volumes: every object of a good file, damaged in every way, with a verdict on each.

What is not in a ``HARMLESS`` table must be refused. A field that may be missing is harmless when it is missing, and
only what says what a thing is called, or what is not read, may hold anything.
"""

import random
from collections.abc import Iterator, Mapping
from pathlib import Path

import h5py
import numpy as np
from corpus.case import Case, filled, truncated
from corpus.hdf5_damage import BOMB, FIELD, GROUP, TEXT, Change, attribute, on, value

SCAN = ("reconstruct", "{file}", "--method", "fdk", "-o", "{out}")
VOLUME = ("export", "{file}", "--to", "npy", "-o", "{out}")
CLOUD = ("export", "{file}", "--to", "npz", "-o", "{out}")
PHANTOM = ("simulate", "--volume", "{file}", "--detector", "8", "--views", "2", "-o", "{out}")

_D, _E, _R = "entry/instrument/detector", "entry/phyradgs", "entry/reconstruction"
_ABSENT = ("removed", "a dangling link")
_ANY_TEXT, _ANY_NUMBER, _ANY_GROUP = tuple(TEXT), tuple(FIELD), tuple(GROUP)
# an encoder table is there, so what the end angles say is not looked at; where they lie is
_UNREAD = (
    *_ABSENT,
    *("a text", "texts", "an axis more", "nothing in it", "complex", "a compound", "references"),
    *("NaN", "infinite", "minus infinite", "extreme", "minus extreme"),
)

HARMLESS_FLY: Mapping[str, tuple[str, ...]] = {
    "entry/data": _ANY_GROUP,  # links for viewers
    "entry/definition": _ANY_TEXT,
    "entry/sample/name": _ANY_TEXT,
    "entry/title": ("removed", "another word", "not UTF-8"),
    "entry/sample/rotation_angle_end": _UNREAD,
    f"{_E}/detector_model": ("removed",),
    f"{_E}/detector_offset": _ABSENT,
    f"{_E}/grid/offset": _ABSENT,
    f"{_E}/kinematics": _ABSENT,  # then the end angles count
    f"{_E}/provenance": ("removed",),
    f"{_E}/reference": _ABSENT,
}
HARMLESS_COUNTS: Mapping[str, tuple[str, ...]] = {
    f"{_D}/pixel_mask": _ABSENT,
    f"{_E}/lag": _ABSENT,
    "entry/sample/rotation_angle_end": _ABSENT,  # a gantry that stands
}
COUNTS = (f"{_D}/data", f"{_D}/image_key", *HARMLESS_COUNTS, f"{_E}/pulse_start", f"{_E}/pulse_length")
HARMLESS_VOLUME: Mapping[str, tuple[str, ...]] = {
    "entry/gaussians": _ABSENT,
    "entry/metrics": _ABSENT,
    "entry/provenance": _ABSENT,
    "entry/grid": _ABSENT,  # then the axes count
    "entry/grid/offset": _ABSENT,
    f"{_R}/title": _ANY_TEXT,
    # the grid is there, so the axes are for viewers
    **{f"{_R}/{axis}": _ANY_NUMBER for axis in "xyz"},
}
UNITS = {"an unknown unit": "furlong", "a unit that is a number": 3.0, "units in a list": ["mm", "mm"]}


def cases(good: Path, seed: int) -> Iterator[Case]:
    """Of raw counts, volumes and bare volumes. Every object of a scan is damaged in tests/io/test_scan_damaged.py."""
    yield from (
        case
        for case in field_cases(good, "counts.h5", SCAN, HARMLESS_COUNTS)
        if any(f" {address}:" in case.name for address in COUNTS)
    )
    yield from field_cases(good, "volume.h5", VOLUME, HARMLESS_VOLUME)
    yield from field_cases(good, "bare.h5", PHANTOM, {})
    yield from _units(good)
    yield from _whole_files(seed)
    yield from _numbers()
    yield from _bombs()


def damages_of(thing: h5py.Group | h5py.Dataset) -> Mapping[str, Change]:
    """What can be done to an object, by its kind."""
    if isinstance(thing, h5py.Group):
        return GROUP
    return TEXT if h5py.check_string_dtype(thing.dtype) else FIELD


def field_cases(
    good: Path, of: str, command: tuple[str, ...], harmless: Mapping[str, tuple[str, ...]]
) -> Iterator[Case]:
    """Every object of a good file in every way."""
    addresses: list[tuple[str, Mapping[str, Change]]] = []
    with h5py.File(good / of) as file:
        file.visititems(lambda name, thing: addresses.append((name, damages_of(thing))))
    for address, damages in addresses:
        for name, change in damages.items():
            refused = name not in harmless.get(address, ())
            asked = CLOUD if address.startswith("entry/gaussians/") else command
            yield Case(f"{of}: {address}: {name}", of, on(address, change), asked, refused)


def _units(good: Path) -> Iterator[Case]:
    """Every dataset with a unit gets wrong ones."""
    for of, command in (("fly.h5", SCAN), ("volume.h5", VOLUME)):
        for address in _with_units(good / of):
            unread = address.endswith("rotation_angle_end") or address in [f"{_R}/{axis}" for axis in "xyz"]
            for name, unit in UNITS.items():
                change = attribute("units", unit)
                yield Case(f"{of}: {address}: {name}", of, on(address, change), command, not unread)


def _with_units(path: Path) -> list[str]:
    addresses: list[str] = []
    with h5py.File(path) as file:
        file.visititems(lambda name, thing: addresses.append(name) if "units" in thing.attrs else None)
    return addresses


def _whole_files(seed: int) -> Iterator[Case]:
    """Cut off somewhere, empty, of another kind."""
    draw = random.Random(seed)
    for of, command in (("fly.h5", SCAN), ("counts.h5", SCAN), ("volume.h5", VOLUME), ("bare.h5", PHANTOM)):
        for _ in range(6):
            keep = draw.uniform(0.01, 0.97)
            yield Case(f"{of}: cut off after {keep:.3f}", of, truncated(keep), command)
        for name, data in (
            ("empty", b""),
            ("text", b"not HDF5 at all\n" * 100),
            ("a signature and noise", b"\x89HDF\r\n\x1a\n" + draw.randbytes(5000)),
            ("noise", draw.randbytes(5000)),
            ("a pickle", b"cos\nsystem\n(S'touch canary'\ntR."),
        ):
            yield Case(f"{of}: {name}", of, filled(data), command)
    wrong = (("volume.h5", SCAN), ("bare.h5", SCAN), ("fly.h5", VOLUME), ("scanner.toml", PHANTOM))
    for of, command in wrong:
        yield Case(f"{of} as another kind: {command[0]}", of, lambda path: None, command)


def _numbers() -> Iterator[Case]:
    """Single numbers of scans that no scanner has."""
    for address, values in {
        f"{_D}/x_pixel_size": (0.0, -1.0, 1e-300, 1e12),
        f"{_D}/y_pixel_size": (0.0, -1.0, 1e-300),
        f"{_D}/distance": (0.0, -3.0, 1e15),
        "entry/instrument/source/distance": (0.0, 1e15),
        f"{_D}/count_time": (-1.0, 1e20),
        f"{_D}/detector_readout_time": (-1.0, 1e20),
        f"{_E}/readout_direction": (0, 2, 0.5),
        f"{_E}/lag": (-0.1, 0.99),
        f"{_E}/pulse_length": (0.0, -1.0),
        f"{_E}/pulse_start": (1e6,),
    }.items():
        of = "counts.h5" if address.rsplit("/", 1)[1] in ("lag", "pulse_length", "pulse_start") else "fly.h5"
        for number in values:
            yield Case(f"{of}: {address} = {number}", of, on(address, value(number)), SCAN)
    for shape in ([0, 8, 8], [-1, 8, 8], [10**7, 10**7, 10**7], [2**62, 2**62, 2**62]):
        yield Case(f"fly.h5: a grid of {shape}", "fly.h5", on(f"{_E}/grid/shape", value(shape)), SCAN)
    keys = {"no projections": [1] * 8, "no flats": [2, 3, 0, 0, 3, 0, 0, 3], "a key of 7": [7] * 8}
    for name, key in keys.items():
        yield Case(f"counts.h5: {name}", "counts.h5", on(f"{_D}/image_key", value(key)), SCAN)
    for quantity in ("hounsfield", 3, ["counts"] * 2):
        change = attribute("quantity", quantity)
        yield Case(f"fly.h5: quantity {quantity!r}", "fly.h5", on(f"{_D}/data", change), SCAN)
    deep = value("[" * 100_000)
    yield Case("fly.h5: JSON too deep", "fly.h5", on(f"{_E}/provenance", deep), SCAN)
    for name, address, change, command in (
        ("a truth of -1e30", f"{_R}/volume", _poked(-1e30), VOLUME),
        ("provenance as a list", "entry/provenance/json", value("[1]"), VOLUME),
        ("JSON too deep", "entry/provenance/json", deep, VOLUME),
        ("no Gaussians to export", "entry/gaussians", GROUP["removed"], CLOUD),
        ("half a cloud", "entry/gaussians/scale", FIELD["removed"], CLOUD),
        ("a cloud of two sizes", "entry/gaussians/scale", FIELD["an axis more"], CLOUD),
    ):
        yield Case(f"volume.h5: {name}", "volume.h5", on(address, change), command)
    for of, command in (("fly.h5", SCAN), ("volume.h5", VOLUME)):
        yield Case(f"{of}: a group that holds itself", of, on("entry", _cycle), command, refused=False)


def _bombs() -> Iterator[Case]:
    for of, address, command in (
        ("fly.h5", f"{_D}/data", SCAN),
        ("fly.h5", f"{_E}/reference/volume", SCAN),
        ("counts.h5", f"{_D}/pixel_mask", SCAN),
        ("volume.h5", f"{_R}/volume", VOLUME),
        ("volume.h5", "entry/gaussians/mean", VOLUME),
        ("bare.h5", "volume", PHANTOM),
    ):
        yield Case(f"{of}: {address}: a compression bomb", of, on(address, BOMB), command)
    yield Case("volume.h5: one array many times", "volume.h5", on("entry/gaussians", _many_links), VOLUME)


def _poked(number: float) -> Change:
    return lambda file, address: file[address].__setitem__((0, 0, 0), np.float32(number))


def _cycle(file: h5py.File, address: str) -> None:
    file[f"{address}/again"] = file[address]


def _many_links(file: h5py.File, address: str) -> None:
    """One array of 64 MiB of zeros, in hardly any bytes, under a thousand names."""
    first = file.create_dataset(f"{address}/a0", (1 << 24,), "f4", compression="gzip", chunks=(1 << 20,))
    for number in range(1, 1000):
        file[f"{address}/a{number}"] = first
