"""Scans and volumes: every object of a good file, damaged in every way, with a verdict on each.

What is not in a ``HARMLESS`` table must be refused. A field that may be missing is harmless when it is missing, and
only what says what a thing is called, or what is not read, may hold anything.
"""

import random
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from corpus.hdf5_damage import BOMB, FIELD, GROUP, TEXT, Change, Damage, attribute, on, truncated, value

_D, _E, _R = "entry/instrument/detector", "entry/phyradgs", "entry/reconstruction"
_ABSENT = ("removed", "a dangling link")
_ANY_TEXT, _ANY_NUMBER, _ANY_GROUP = tuple(TEXT), tuple(FIELD), tuple(GROUP)
# an encoder table is there, so what the end angles say is not looked at; where they lie is
_UNREAD = (
    *_ABSENT,
    *("a text", "texts", "an axis more", "nothing in it", "complex", "a compound", "references"),
    *("NaN", "infinite", "minus infinite", "extreme", "minus extreme", "declared huge", "declared huge in chunks"),
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
_WHOLE = ("entry", _R, "volume")  # without them it is a file of another kind
_OTHERS = (("entry/gaussians/mean", "nothing in it"),)  # the first says how many there are
UNITS = {"an unknown unit": "furlong", "a unit that is a number": 3.0, "units in a list": ["mm", "mm"]}


class Case(NamedTuple):
    """A damaged copy of the good file ``of``, and the verdict on it: refused, or read as if nothing were wrong."""

    name: str
    of: str
    damage: Damage
    refused: bool = True
    address: str = ""
    """The HDF5 path that the message must name."""


def cases(good: Path, seed: int) -> Iterator[Case]:
    """Of raw counts, volumes and bare volumes. Every object of a scan is damaged in tests/io/test_scan_damaged.py."""
    yield from (
        case
        for case in field_cases(good, "counts.h5", HARMLESS_COUNTS)
        if any(f" {address}:" in case.name for address in COUNTS)
    )
    yield from field_cases(good, "volume.h5", HARMLESS_VOLUME)
    yield from field_cases(good, "bare.h5", {})
    yield from _units(good)
    yield from _whole_files(seed)
    yield from _numbers()
    yield from _bombs()


def damages_of(thing: h5py.Group | h5py.Dataset) -> Mapping[str, Change]:
    """What can be done to an object, by its kind."""
    if isinstance(thing, h5py.Group):
        return GROUP
    return TEXT if h5py.check_string_dtype(thing.dtype) else FIELD


def field_cases(good: Path, of: str, harmless: Mapping[str, tuple[str, ...]]) -> Iterator[Case]:
    """Every object of a good file in every way."""
    addresses: list[tuple[str, Mapping[str, Change]]] = []
    with h5py.File(good / of) as file:
        file.visititems(lambda name, thing: addresses.append((name, damages_of(thing))))
    for address, damages in addresses:
        for name, change in damages.items():
            refused = name not in harmless.get(address, ())
            named = "" if address in _WHOLE or (address, name) in _OTHERS else address
            yield Case(f"{of}: {address}: {name}", of, on(address, change), refused, named)


def _units(good: Path) -> Iterator[Case]:
    """Every dataset with a unit gets wrong ones."""
    for of in ("fly.h5", "volume.h5"):
        for address in _with_units(good / of):
            unread = address.endswith("rotation_angle_end") or address in [f"{_R}/{axis}" for axis in "xyz"]
            for name, unit in UNITS.items():
                yield Case(f"{of}: {address}: {name}", of, on(address, attribute("units", unit)), not unread)


def _with_units(path: Path) -> list[str]:
    addresses: list[str] = []
    with h5py.File(path) as file:
        file.visititems(lambda name, thing: addresses.append(name) if "units" in thing.attrs else None)
    return addresses


def _whole_files(seed: int) -> Iterator[Case]:
    """Cut off somewhere, empty, of another kind."""
    draw = random.Random(seed)
    contents = {"empty": b"", "text": b"not HDF5 at all\n" * 100, "noise": draw.randbytes(5000)}
    contents["a signature and noise"] = b"\x89HDF\r\n\x1a\n" + draw.randbytes(5000)
    for of in ("fly.h5", "counts.h5", "volume.h5", "bare.h5"):
        for _ in range(6):
            keep = draw.uniform(0.01, 0.97)
            yield Case(f"{of}: cut off after {keep:.3f}", of, truncated(keep))
        for name, data in contents.items():
            yield Case(f"{of}: {name}", of, lambda path, data=data: path.write_bytes(data))


def _numbers() -> Iterator[Case]:
    """Single numbers that no scanner has, beyond those of tests/io/test_scan_damaged.py, and texts without end."""
    for address, values in {
        f"{_D}/x_pixel_size": (1e-300, 1e12),
        f"{_D}/distance": (1e15,),
        "entry/instrument/source/distance": (1e15,),
        f"{_D}/count_time": (1e20,),
        f"{_D}/detector_readout_time": (1e20,),
        f"{_E}/grid/shape": ([-1, 8, 8], [10**7, 10**7, 10**7], [2**62, 2**62, 2**62]),
        f"{_E}/provenance": ("[" * 100_000,),
        f"{_E}/lag": (-0.1, 1.0),
        f"{_E}/pulse_length": (0.0,),
        f"{_E}/pulse_start": (7.0e3,),
    }.items():
        for number in values:
            of = "counts.h5" if address.endswith(("lag", "pulse_length", "pulse_start")) else "fly.h5"
            yield Case(f"{of}: {address} = {str(number)[:30]}", of, on(address, value(number)), True, address)
    keys = {"no projections": [1] * 8, "no flats": [2, 3, 0, 0, 3, 0, 0, 3], "a key of 7": [7] * 8}
    for name, key in keys.items():
        yield Case(f"counts.h5: {name}", "counts.h5", on(f"{_D}/image_key", value(key)))
    yield Case("volume.h5: a value of -1e30", "volume.h5", on(f"{_R}/volume", _poked))
    yield Case("volume.h5: JSON too deep", "volume.h5", on("entry/provenance/json", value("[" * 100_000)))
    for of in ("fly.h5", "volume.h5"):
        yield Case(f"{of}: a group that holds itself", of, on("entry", _cycle), refused=False)


def _bombs() -> Iterator[Case]:
    for of, address in (
        ("fly.h5", f"{_D}/data"),
        ("fly.h5", f"{_E}/reference/volume"),
        ("counts.h5", f"{_D}/pixel_mask"),
        ("volume.h5", f"{_R}/volume"),
        ("volume.h5", "entry/gaussians/mean"),
    ):
        yield Case(f"{of}: {address}: a compression bomb", of, on(address, BOMB))
    yield Case("volume.h5: one array many times", "volume.h5", on("entry/gaussians", _many_links), refused=False)


def _poked(file: h5py.File, address: str) -> None:
    file[address][0, 0, 0] = np.float32(-1e30)


def _cycle(file: h5py.File, address: str) -> None:
    file[f"{address}/again"] = file[address]


def _many_links(file: h5py.File, address: str) -> None:
    """One array of 64 MiB of zeros, in hardly any bytes, under a thousand names."""
    first = file.create_dataset(f"{address}/a0", (1 << 24,), "f4", compression="gzip", chunks=(1 << 20,))
    for number in range(1, 1000):
        file[f"{address}/a{number}"] = first
