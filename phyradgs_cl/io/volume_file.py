"""Volume files: a reconstruction with its grid, its history and its Gaussians, as an NXdata in HDF5."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io.atomic import written_beside
from phyradgs_cl.io.datasets import in_unit, new_group, read_array, read_values, read_word, write_number
from phyradgs_cl.io.grid_io import read_grid, write_grid
from phyradgs_cl.io.hashing import sha256_of
from phyradgs_cl.io.hdf5 import Hdf5Source, open_hdf5
from phyradgs_cl.io.new_hdf5 import new_hdf5
from phyradgs_cl.io.units import ATTENUATION, LENGTH

_DATA = "/entry/reconstruction"
_VOLUME = f"{_DATA}/volume"
_AXES = ("z", "y", "x")
_MOST_ARRAYS = 16
_AXIS_TOLERANCE = 1e-3  # of a voxel: what axes stored in float32 need
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class StoredVolume:
    """A volume file: volume (nz, ny, nx) float32 in 1/mm on ``grid``, and what is kept beside it.

    ``gaussians`` maps names to arrays of G rows, ``metrics`` names to numbers; None where there are none.
    """

    volume: np.ndarray
    grid: Grid
    provenance: dict[str, object]
    gaussians: dict[str, np.ndarray] | None = None
    metrics: dict[str, object] | None = None


def write_volume(
    path: str | Path,
    volume: np.ndarray,
    grid: Grid,
    provenance: Mapping[str, object],
    gaussians: Mapping[str, np.ndarray] | None = None,
    metrics: Mapping[str, object] | None = None,
) -> None:
    """Write a volume (nz, ny, nx) in 1/mm with everything needed to make it again, whole or not at all.

    ``provenance`` and ``metrics`` are stored as JSON, plain values also as attributes; arrays of
    ``gaussians`` as datasets of their names.

    Raises:
        InputError: a volume that is not finite or does not fit its grid.
        OutputError: the file cannot be written.
    """
    checks.shape("volume", volume, grid.shape)
    checks.finite("volume", volume)
    with written_beside(path) as temporary, new_hdf5(temporary) as file:
        file.attrs["NX_class"], file.attrs["default"] = "NXroot", "entry"
        entry = new_group(file, "entry", "NXentry")
        entry.attrs["default"] = "reconstruction"
        _write_data(entry, np.asarray(volume, np.float32), grid)
        write_grid(entry, grid)
        _write_facts(entry, "provenance", provenance)
        if metrics is not None:
            _write_facts(entry, "metrics", metrics)
        if gaussians is not None:
            group = new_group(entry, "gaussians", "NXcollection")
            for name, values in gaussians.items():
                group.create_dataset(name, data=values)


def read_volume(path: str | Path) -> StoredVolume:
    """Read a volume file; InputError names what is wrong by its HDF5 path. A run that was interrupted is a warning."""
    with open_hdf5(path) as source:
        dataset, grid = _checked(source)
        values = read_values(source, _VOLUME, dataset)
        checks.finite(source.name(_VOLUME), values)
        volume = in_unit(source, _VOLUME, values, ATTENUATION).astype(np.float32)
        provenance = read_provenance(source)
        return StoredVolume(volume, grid, provenance, _read_gaussians(source), _read_facts(source, "metrics"))


def volume_summary(path: str | Path) -> dict[str, object]:
    """Facts about a volume file, for people, without reading the voxels."""
    with open_hdf5(path) as source:
        _, grid = _checked(source)
        group = source.optional_group("/entry/gaussians")
        counts = [len(values) for values in (group or {}).values() if getattr(values, "ndim", 0)]
        return {
            "shape": grid.shape,
            "voxel_size_mm": grid.voxel_size_mm,
            "offset_mm": grid.offset_mm,
            "provenance": read_provenance(source),
            "metrics": _read_facts(source, "metrics"),
            "gaussians": max(counts, default=0),
            "sha256": sha256_of(path),
        }


def file_kind(path: str | Path) -> str:
    """What an HDF5 file holds: "scan", "volume", or "plain-volume" (a bare dataset /volume).

    Raises:
        InputError: not readable, or none of the three.
    """
    with open_hdf5(path) as source:
        if isinstance(source.find(_DATA), h5py.Group):
            return "volume"
        if isinstance(source.find("/volume"), h5py.Dataset):
            return "plain-volume"
        if any(source.find(f"{group}/instrument") is not None for group in source.root_groups()):
            return "scan"
        members = ", ".join(sorted(source.file)) or "nothing"
    expected = "a scan (/entry/instrument), a volume (/entry/reconstruction) or a dataset /volume"
    raise InputError(f"{path}:/", f"members: {members}", expected, "check the path")


def read_provenance(source: Hdf5Source) -> dict[str, object]:
    """How a volume came about; says once if its run was interrupted."""
    provenance = _read_facts(source, "provenance") or {}
    if where := interruption(provenance):
        of = "" if where["iterations_asked"] is None else f" of {where['iterations_asked']}"
        _say_once(source.path, f"interrupted at iteration {where['interrupted_at']}{of}")
    return provenance


def interruption(provenance: Mapping[str, object]) -> dict[str, int | None]:
    """``interrupted_at`` and ``iterations_asked`` of a run that was interrupted; nothing of one that was not."""
    at, options = provenance.get("interrupted_at"), provenance.get("options")
    if type(at) is not int:  # a truth is an int too
        return {}
    asked = options.get("iterations") if isinstance(options, Mapping) else None
    return {"interrupted_at": at, "iterations_asked": asked if type(asked) is int else None}


@cache
def _say_once(path: Path, text: str) -> None:
    log.warning("%s: %s", path, text)


def _write_data(entry: h5py.Group, volume: np.ndarray, grid: Grid) -> None:
    group = new_group(entry, "reconstruction", "NXdata")
    group.attrs["signal"], group.attrs["axes"] = "volume", list(_AXES)
    group["title"] = "attenuation (1/mm)"
    dataset = group.create_dataset("volume", data=volume)
    dataset.attrs.update(units="1/mm", long_name="attenuation (1/mm)", interpretation="image")
    for name, centres_mm in zip(_AXES, grid.axes_mm(), strict=True):
        write_number(group, name, centres_mm, "mm", long_name=f"{name} (mm)")


def _write_facts(entry: h5py.Group, name: str, facts: Mapping[str, object]) -> None:
    group = new_group(entry, name, "NXcollection")
    group["json"] = json.dumps(dict(facts), default=_plain)
    for key, value in facts.items():
        value = value.item() if isinstance(value, np.generic) else value
        fits = isinstance(value, (bool, float)) or (isinstance(value, int) and abs(value) < 2**63)
        if fits or (isinstance(value, str) and len(value) < 1000 and "\0" not in value):
            group.attrs[str(key)] = value


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else str(value)


def _checked(source: Hdf5Source) -> tuple[h5py.Dataset, Grid]:
    """The volume's dataset, unread, and its grid; they fit each other."""
    dataset = source.dataset(_VOLUME, ("title", *_AXES))
    if dataset.ndim != 3 or min(dataset.shape) < 1:
        raise InputError(source.name(_VOLUME), f"shape {dataset.shape}", "three axes (z, y, x), none empty")
    stored = source.optional_group("/entry/grid", ("reconstruction", "provenance", "metrics", "gaussians"))
    grid = read_grid(source, "/entry/grid") if stored is not None else _grid_of_axes(source, dataset.shape)
    if grid.shape != dataset.shape:
        raise InputError(source.name(_VOLUME), f"shape {dataset.shape}", f"the grid's {grid.shape}")
    return dataset, grid


def _grid_of_axes(source: Hdf5Source, shape: tuple[int, ...]) -> Grid:
    steps_mm, centres_mm = [], []
    for name, count in zip(_AXES, shape, strict=True):
        axis_mm = read_array(source, f"{_DATA}/{name}", (count,), LENGTH, ("volume", "title", *_AXES))
        step_mm = float((axis_mm[-1] - axis_mm[0]) / max(count - 1, 1))
        even_mm = axis_mm[0] + np.arange(count) * step_mm
        if step_mm <= 0 or np.abs(axis_mm - even_mm).max() > _AXIS_TOLERANCE * step_mm:
            found = "one value" if count == 1 else "values that do not rise evenly"
            raise InputError(
                source.name(f"{_DATA}/{name}"), found, "even steps in mm, or a group /entry/grid"
            )
        steps_mm.append(step_mm)
        centres_mm.append(float(axis_mm[0] + axis_mm[-1]) / 2)
    return Grid(tuple(shape), tuple(steps_mm), tuple(centres_mm))


def _read_facts(source: Hdf5Source, name: str) -> dict[str, object] | None:
    address = f"/entry/{name}/json"
    if source.optional_group(f"/entry/{name}") is None:
        return None
    try:
        facts = json.loads(read_word(source, address))
    except ValueError as error:
        raise InputError(source.name(address), f"text that is not JSON ({error})", "a JSON object") from error
    if not isinstance(facts, dict):
        raise InputError(source.name(address), f"JSON {type(facts).__name__}", "a JSON object")
    return facts


def _read_gaussians(source: Hdf5Source) -> dict[str, np.ndarray] | None:
    group = source.optional_group("/entry/gaussians")
    if group is None:
        return None
    if len(group) > _MOST_ARRAYS:  # each may be all of the file, once more
        raise InputError(source.name("/entry/gaussians"), f"{len(group)} arrays", f"at most {_MOST_ARRAYS}")
    addresses = {name: f"/entry/gaussians/{name}" for name in group}
    arrays = {name: read_values(source, a, source.dataset(a)) for name, a in addresses.items()}
    for name, values in arrays.items():
        with np.errstate(over="ignore"):  # what float32 cannot hold is infinite for everybody who reads on
            checks.finite(source.name(addresses[name]), values.astype(np.float32))
    return arrays
