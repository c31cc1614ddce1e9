"""Reads and writes volume files: NeXus NXdata in HDF5, with grid, provenance and Gaussians. Also reads bare arrays."""

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Gaussians, Grid, Hounsfield, States, deformed, triple
from phyradgs_cl.fields.hounsfield import Box, fitted, of_facts
from phyradgs_cl.io.deformation import DEFORMATION, read_deformation_group, write_deformation_group
from phyradgs_cl.io.files import sha256_of
from phyradgs_cl.io.hdf5 import Hdf5Source, open_hdf5
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.tables import PROVENANCE, read_facts
from phyradgs_cl.text import plain_text

_DATA = "/entry/reconstruction"
_VOLUME, _DOUBT, _BARE = f"{_DATA}/volume", f"{_DATA}/doubt", "/volume"
_AXES = ("z", "y", "x")
_GAUSSIANS, _STATE, _STATES = "/entry/gaussians", "/entry/state", "/entry/time_series"
_CLOUD = {"mean": (3,), "scale": (3,), "quaternion": (4,), "density": ()}
_AXIS_TOLERANCE = 1e-3  # stored voxel centres may differ from even steps by this fraction of a step, as float32 rounds them
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Volume:
    """Values (nz, ny, nx) float32 in 1/mm and their grid, None for a bare array. provenance: how they were made, in the
    types of ``tables.PROVENANCE``. gaussians: float32, in mm and 1/mm. metrics: by name. deformation: the object's motion
    from this volume. states: the object at several times, whose mean is this volume. doubt: σ (nz, ny, nx) in 1/mm.
    is_stated: whether the file states the values' unit, so that values of any size are in 1/mm."""

    values: np.ndarray
    grid: Grid | None
    provenance: dict[str, object] = field(default_factory=dict)
    gaussians: Gaussians | None = None
    metrics: dict[str, object] | None = None
    deformation: Deformation | None = None
    states: States | None = None
    doubt: np.ndarray | None = None
    is_stated: bool = False

    def at(self, time_s: float) -> np.ndarray:
        """Returns the values (nz, ny, nx) in 1/mm at a time in s; ``values`` for an object without states and motion."""
        if self.states is not None:
            return self.states.at(time_s)
        if (field := self.deformation) is None:
            return self.values
        return deformed(self.values, self.required_grid, field, field.weights_at(time_s)[0])

    def moved_by(self, deformation: Deformation, subject: str) -> "Volume":
        """Returns the volume with another deformation. Raises InputError, which names ``subject``, for one with states."""
        if self.states is not None:
            found, expected = f"{subject}, which holds its states", "a volume whose object does not change"
            raise InputError("--object-motion", found, expected, "leave it out")
        return replace(self, deformation=deformation)

    @property
    def scale(self) -> Hounsfield | None:
        """The scale of Hounsfield units in the file, or None."""
        return of_facts(self.provenance)

    def hounsfield(self, air: Box | None = None, water: Box | None = None, insert_hu: float = 0.0) -> "Volume":
        """Returns the volume, still in 1/mm, with a scale of Hounsfield units. See ``hounsfield.fitted``. Raises InputError
        for values below −10, which are no attenuation, unless the file states their unit."""
        if not self.is_stated and self.values.min() < -10:
            found = f"values from {self.values.min():g}, as of Hounsfield units"
            raise InputError("--hu", found, "attenuation in 1/mm")
        scale = fitted(self.values, self.required_grid, air, water, insert_hu)
        return replace(self, provenance={**self.provenance, **scale.facts()})

    @property
    def required_grid(self) -> Grid:
        """The grid. Raises InputError if the volume has none."""
        if self.grid is None:
            raise InputError("volume", "values without voxel sizes", "a volume with its grid in mm")
        return self.grid


def write_volume(
    path: str | Path, volume: np.ndarray, grid: Grid, provenance: Mapping[str, object],
    gaussians: Gaussians | None = None, metrics: Mapping[str, object] | None = None,
    state: Mapping[str, np.ndarray] | None = None, deformation: Deformation | None = None, states: States | None = None,
    doubt: np.ndarray | None = None,
) -> None:
    """Writes a volume (nz, ny, nx) in 1/mm, completely or not at all. provenance, metrics: stored as JSON, plain values
    also as attributes. gaussians: stored as float32. state: arrays and texts from which an interrupted run resumes.
    deformation: how the object moves. states: the object at several times. doubt: σ in 1/mm (nz, ny, nx). Raises InputError
    if an array is not finite or does not fit the grid, OutputError if the file cannot be written."""
    of_grid = {"volume": volume} if doubt is None else {"volume": volume, "doubt": doubt}
    for name, values in of_grid.items():
        checks.shape(name, values, grid.shape)
        checks.finite(name, values)
    arrays = [*of_grid.values(), *(state or {}).values(), *([] if gaussians is None else vars(gaussians).values())]
    arrays += [] if states is None else [states.volumes]
    with h5.new_hdf5(path, sum(values.nbytes for values in arrays)) as file:
        entry = h5.new_group(file, "entry", "NXentry")
        entry.attrs["default"] = "reconstruction"
        _write_data(entry, "reconstruction", "attenuation (1/mm)", volume, grid)
        if doubt is not None:
            _write_attenuation(entry["reconstruction"], "doubt", doubt, "σ of the attenuation (1/mm)")
            entry["reconstruction"].attrs["auxiliary_signals"] = ["doubt"]
        h5.write_grid(entry, grid)
        _write_facts(entry, "provenance", provenance)
        if metrics is not None:
            _write_facts(entry, "metrics", metrics)
        if gaussians is not None:
            group = h5.new_group(entry, "gaussians", "NXcollection")
            for name in _CLOUD:
                group.create_dataset(name, data=np.asarray(getattr(gaussians, name), np.float32))
        if deformation is not None:
            write_deformation_group(entry, deformation)
        if states is not None:
            title = "attenuation (1/mm) at some times"
            group = _write_data(entry, "time_series", title, states.volumes, grid, ("time_s",), chunks=(1, *grid.shape))
            h5.write_number(group, "time_s", states.times_s, "s", long_name="time (s)")
        if state is not None:
            group = h5.new_group(entry, "state", "NXcollection")
            for name, values in state.items():
                group[name] = str(values) if values.dtype.kind == "U" else values


def read_volume(path: str | Path) -> Volume:
    """Reads a volume file, or a bare array /volume (z, y, x). A bare array has no grid, and integers are divided by the
    maximum of their type. Raises InputError, with the HDF5 path, for damage. Warns of an interrupted run, and of provenance
    of a wrong type, which is left out."""
    with open_hdf5(path) as source:
        if isinstance(source.find(_BARE), h5py.Dataset):
            dataset, subject = source.dataset(_BARE), source.name(_BARE)
            if dataset.ndim != 3 or 0 in dataset.shape:
                raise InputError(subject, f"shape {dataset.shape}", "three axes (z, y, x), none of them empty")
            return Volume(finite_float32(subject, shares_of_maximum(h5.read_values(source, _BARE, dataset))), None)
        if not isinstance(source.find(_DATA), h5py.Group):
            found = "root members " + (", ".join(sorted(source.file)[:10]) or "none")
            raise InputError(str(path), found, f"a 3D dataset {_BARE} or {_VOLUME}")
        dataset, grid = _dataset_and_grid(source)
        values = h5.read_attenuation(source, _VOLUME, dataset)
        provenance, gaussians, metrics = _read_provenance(source), _read_gaussians(source), _read_metrics(source)
        deformation = None if source.find(DEFORMATION) is None else read_deformation_group(source, DEFORMATION)
        states = _read_states(source, grid.shape)
        if (sigma := source.optional(_DOUBT)) is not None:
            checks.shape(source.name(_DOUBT), sigma, grid.shape)
        doubt = None if sigma is None else h5.read_attenuation(source, _DOUBT, sigma)
        is_stated = not {"units", "unit"}.isdisjoint(dataset.attrs)
        return Volume(values, grid, provenance, gaussians, metrics, deformation, states, doubt, is_stated)


def read_state(path: str | Path) -> dict[str, np.ndarray] | None:
    """Reads the arrays, by name, from which an interrupted run resumes. Returns None if there are none and, with a warning,
    if they are damaged. The caller must check the arrays' shapes."""
    with open_hdf5(path) as source:
        try:
            group = source.optional_group(_STATE)
            return None if group is None else {name: _read_part(source, f"{_STATE}/{name}") for name in group}
        except InputError as error:
            log.warning("%s", error)
            return None


def volume_summary(path: str | Path) -> dict[str, Any]:
    """Returns what 'phyradgs info' prints about a volume file, without its voxels. Raises InputError for a damaged file."""
    with open_hdf5(path) as source:
        _, grid = _dataset_and_grid(source)
        means = source.optional(f"{_GAUSSIANS}/mean") if source.optional_group(_GAUSSIANS) else None
        times_s = None if (stored := _states_datasets(source, grid.shape)) is None else stored[0]
        states = None if times_s is None else (len(times_s), float(times_s[0]), float(times_s[-1]))
        return {
            "shape": grid.shape, "voxel_size_mm": grid.voxel_size_mm, "offset_mm": grid.offset_mm,
            "provenance": _read_provenance(source), "metrics": _read_metrics(source),
            "gaussians": means.shape[0] if means is not None and means.ndim else 0,
            **dict(zip(("states", "states_from_s", "states_to_s"), states or (), strict=False)),
            "sha256": sha256_of(path),
        }


def read_states(path: str | Path) -> States | None:
    """Reads the object at several times from a volume file; None if the file has a single volume."""
    with open_hdf5(path) as source:
        return _read_states(source, _dataset_and_grid(source)[1].shape)


def file_kind(path: str | Path) -> str:
    """Returns the kind of an HDF5 file: "scan", "volume", "plain-volume" (a bare dataset /volume) or "deformation". Raises
    InputError for any other file."""
    with open_hdf5(path) as source:
        if isinstance(source.find(_DATA), h5py.Group):
            return "volume"
        if isinstance(source.find(_BARE), h5py.Dataset):
            return "plain-volume"
        if any(source.find(f"{group}/instrument") is not None for group in source.groups()):
            return "scan"
        if isinstance(source.find(DEFORMATION), h5py.Group):
            return "deformation"
        members = ", ".join(sorted(source.file)) or "nothing"
    expected = "a scan (/entry/instrument), a volume (/entry/reconstruction), a dataset /volume or /entry/deformation"
    raise InputError(f"{path}:/", f"members: {members}", expected, "check the path")


def _read_provenance(source: Hdf5Source) -> dict[str, object]:
    """Reads a volume's provenance; {} if the file has none. Warns, once per file, of an interrupted run."""
    provenance = _read_facts(source, "provenance", PROVENANCE) or {}
    if where := place_of(interruption(provenance)):
        _warn_once(source.path, f"interrupted at {where}")
    return provenance


def interruption(provenance: Mapping[str, object]) -> dict[str, object]:
    """Returns where a run was interrupted: ``interrupted_at`` and ``iterations_asked``. If the run consists of several, for
    error bars, adds ``interrupted_in_run``. Returns an empty dict for a complete run."""
    at, options, doubt = (provenance.get(name) for name in ("interrupted_at", "options", "doubt"))
    if type(at) is not int:  # not isinstance, which accepts True
        return {}
    asked = options.get("iterations") if isinstance(options, Mapping) else None
    run = doubt.get("interrupted_in_run") if isinstance(doubt, Mapping) else None
    in_run = {} if run is None else {"interrupted_in_run": run}
    return {"interrupted_at": at, "iterations_asked": asked if type(asked) is int else None, **in_run}


def place_of(stop: Mapping[str, object]) -> str:
    """Returns an ``interruption`` as text, such as "iteration 3 of 40 of run 2 of 3"; "" for a complete run."""
    asked, run = stop.get("iterations_asked"), stop.get("interrupted_in_run")
    of = "" if asked is None else f" of {asked}"
    return f"iteration {stop['interrupted_at']}{of}{'' if run is None else f' of run {run}'}" if stop else ""


@cache
def _warn_once(path: Path, text: str) -> None:
    log.warning("%s: %s", path, text)


def _write_data(
    entry: h5py.Group, name: str, title: str, values: np.ndarray, grid: Grid, before: tuple[str, ...] = (), **how: Any
) -> h5py.Group:
    """Writes values (..., z, y, x) with their axes as NXdata, and returns its group. before: names of the first axes."""
    group = h5.new_group(entry, name, "NXdata")
    group.attrs["signal"], group.attrs["axes"] = "volume", [*before, *_AXES]
    group["title"] = title
    _write_attenuation(group, "volume", values, "attenuation (1/mm)", **how)
    for axis, centres_mm in zip(_AXES, grid.axes_mm(), strict=True):
        h5.write_number(group, axis, centres_mm, "mm", long_name=f"{axis} (mm)")
    return group


def _write_attenuation(group: h5py.Group, name: str, values: np.ndarray, words: str, **how: Any) -> None:
    dataset = group.create_dataset(name, data=np.asarray(values, np.float32), **how)
    dataset.attrs.update(units="1/mm", long_name=words, interpretation="image")


def _write_facts(entry: h5py.Group, name: str, facts: Mapping[str, object]) -> None:
    group = h5.new_group(entry, name, "NXcollection")
    group["json"] = json.dumps(dict(facts), default=_plain)
    for key, value in facts.items():
        value = value.item() if isinstance(value, np.generic) else value
        fits = isinstance(value, (bool, float)) or (isinstance(value, int) and abs(value) < 2**63)
        if fits or (isinstance(value, str) and len(value) < 1000):
            group.attrs[plain_text(str(key))] = plain_text(value) if isinstance(value, str) else value


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else str(value)


def _dataset_and_grid(source: Hdf5Source) -> tuple[h5py.Dataset, Grid]:
    dataset = source.dataset(_VOLUME)
    if dataset.ndim != 3 or min(dataset.shape) < 1:
        raise source.error(_VOLUME, f"shape {dataset.shape}", "three axes (z, y, x), none empty")
    stored = source.optional_group("/entry/grid")
    grid = h5.read_grid(source, "/entry/grid") if stored is not None else _grid_of_axes(source, dataset.shape)
    if grid.shape != dataset.shape:
        raise source.error(_VOLUME, f"shape {dataset.shape}", f"the grid's {grid.shape}")
    return dataset, grid


def _grid_of_axes(source: Hdf5Source, shape: tuple[int, ...]) -> Grid:
    """Derives the grid from the voxels' centres along each axis. Raises InputError if they do not rise evenly."""
    steps_mm: list[float | None] = []
    centres_mm = []
    for name, count in zip(_AXES, shape, strict=True):
        axis_mm = h5.read_array(source, f"{_DATA}/{name}", (count,), h5.LENGTH)
        step_mm = float((axis_mm[-1] - axis_mm[0]) / max(count - 1, 1))
        even_mm = axis_mm[0] + np.arange(count) * step_mm
        if count > 1 and (step_mm <= 0 or np.abs(axis_mm - even_mm).max() > _AXIS_TOLERANCE * step_mm):
            expected = "even steps in mm, or a group /entry/grid"
            raise source.error(f"{_DATA}/{name}", "values that do not rise evenly", expected)
        steps_mm.append(step_mm if count > 1 else None)
        centres_mm.append(float(axis_mm[0] + axis_mm[-1]) / 2)
    usual = next((step for step in steps_mm if step is not None), 1.0)  # for axes of one voxel, which show no spacing
    return Grid(triple(shape), triple(usual if s is None else s for s in steps_mm), triple(centres_mm))


def _read_states(source: Hdf5Source, shape: tuple[int, ...]) -> States | None:
    stored = _states_datasets(source, shape)
    return stored and States(stored[0], h5.read_attenuation(source, f"{_STATES}/volume", stored[1]))


def _states_datasets(source: Hdf5Source, shape: tuple[int, ...]) -> tuple[np.ndarray, h5py.Dataset] | None:
    """Returns times (K,) in s and the dataset (K, nz, ny, nx) of the object at these times; None for a single volume.
    Raises InputError for times that do not rise, and for other shapes."""
    if source.optional_group(_STATES) is None:
        return None
    times_s = h5.read_array(source, f"{_STATES}/time_s", (None,), h5.TIME)
    if len(times_s) == 0 or (np.diff(times_s) <= 0).any():
        raise source.error(f"{_STATES}/time_s", checks.short_repr(times_s.tolist()), "at least one time, rising")
    dataset = source.dataset(f"{_STATES}/volume")
    checks.shape(source.name(f"{_STATES}/volume"), dataset, (len(times_s), *shape))
    return times_s, dataset


def shares_of_maximum(values: np.ndarray) -> np.ndarray:
    """Divides integers by the maximum of their type, in float32; returns other numbers unchanged."""
    return values / np.float32(np.iinfo(values.dtype).max) if values.dtype.kind in "iu" else values


def finite_float32(subject: str, values: np.ndarray) -> np.ndarray:
    """Returns ``values`` as contiguous float32. Raises InputError about ``subject`` for values not finite in float32."""
    with np.errstate(over="ignore"):  # values beyond float32 become infinite
        volume = np.ascontiguousarray(values, np.float32)
    bad = int(volume.size - np.count_nonzero(np.isfinite(volume)))
    if bad:
        raise InputError(subject, f"{bad} voxels that are NaN, infinite or too large", "finite float32 values")
    return volume


def _read_part(source: Hdf5Source, address: str) -> np.ndarray:
    dataset = source.dataset(address)
    is_text = h5py.check_string_dtype(dataset.dtype) is not None
    return np.array(h5.read_word(source, address)) if is_text else h5.read_values(source, address, dataset)


def _read_facts(source: Hdf5Source, name: str, types: Mapping[str, tuple[type, ...]]) -> dict[str, object] | None:
    address = f"/entry/{name}/json"
    if source.optional_group(f"/entry/{name}") is None:
        return None
    return read_facts(source.name(address), h5.read_word(source, address), types)


def _read_metrics(source: Hdf5Source) -> dict[str, object] | None:
    """Reads the metrics, which are numbers by name; None if the file has none. Leaves other values out, with a warning."""
    metrics = _read_facts(source, "metrics", {})
    if metrics is None:
        return None
    wrong = [name for name, value in metrics.items() if isinstance(value, str | bool | dict | list)]
    if wrong:
        log.warning("%s: %s: no numbers, left out", source.name("/entry/metrics"), checks.short_repr(wrong))
    return {name: value for name, value in metrics.items() if name not in wrong}


def _read_gaussians(source: Hdf5Source) -> Gaussians | None:
    if source.optional_group(_GAUSSIANS) is None:
        return None
    arrays: dict[str, np.ndarray] = {}
    for name, rest in _CLOUD.items():
        address = f"{_GAUSSIANS}/{name}"
        dataset = source.dataset(address)
        checks.shape(source.name(address), dataset, (len(arrays.get("mean", ())) if arrays else None, *rest))
        with np.errstate(over="ignore"):  # values beyond float32 become infinite, which is refused below
            arrays[name] = h5.read_values(source, address, dataset).astype(np.float32)
        checks.finite(source.name(address), arrays[name])
    if (arrays["scale"] <= 0).any():
        raise source.error(f"{_GAUSSIANS}/scale", f"{arrays['scale'].min():g}", "lengths above 0")
    return Gaussians(**arrays)
