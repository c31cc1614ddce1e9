"""Volume files in HDF5: a reconstruction as an NXdata with its grid, provenance and Gaussians; also bare arrays /volume."""

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import HOUNSFIELD, Deformation, Gaussians, Grid, Hounsfield, States, deformed, triple
from phyradgs_cl.fields.hounsfield import Box, fitted, of_facts, of_note
from phyradgs_cl.io.deformation import DEFORMATION, read_deformation_group, write_deformation_group
from phyradgs_cl.io.files import sha256_of
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.hdf5.source import Hdf5Source, open_hdf5
from phyradgs_cl.io.tables import PROVENANCE, read_facts
from phyradgs_cl.text import plain_text

if TYPE_CHECKING:
    from xarray import DataArray

_DATA = "/entry/reconstruction"
_VOLUME, _DOUBT, _BARE = f"{_DATA}/volume", f"{_DATA}/doubt", "/volume"
_AXES = ("z", "y", "x")
_GAUSSIANS, _STATE, _STATES = "/entry/gaussians", "/entry/state", "/entry/time_series"
_CLOUD = {"mean": (3,), "scale": (3,), "quaternion": (4,), "density": ()}
_LOWEST_PER_MM, _HIGHEST_PER_MM = -10.0, 1000.0  # beyond noise below 0, and beyond gold
_USUAL_PER_MM = 10.0  # values beyond, of a volume that the user takes for one in HU, are HU
VALUES = "values"
"""The key, in a volume's provenance, of what a file of another format notes of its values."""
FROM_HU = "1/mm, from HU"
"""What it says of a volume that ``in_per_mm`` has converted."""
_AXIS_TOLERANCE = 1e-3  # of a voxel, for axes stored in float32
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Volume:
    """Values (nz, ny, nx) float32 in 1/mm and their grid; None for a bare array. A volume file also holds ``provenance``
    (types as in ``tables.PROVENANCE``), ``gaussians`` float32 in mm and 1/mm, and ``metrics`` by name. deformation: how the
    object moves whose reference the volume is. states: the object at some times, whose mean the volume is. doubt: σ in
    1/mm of the values, in their shape."""

    values: np.ndarray
    grid: Grid | None
    provenance: dict[str, object] = field(default_factory=dict)
    gaussians: Gaussians | None = None
    metrics: dict[str, object] | None = None
    deformation: Deformation | None = None
    states: States | None = None
    doubt: np.ndarray | None = None

    def at(self, time_s: float) -> np.ndarray:
        """Returns the values (nz, ny, nx) at a time in s; of an object that neither moves nor changes always the same."""
        if self.states is not None:
            return self.states.at(time_s)
        if (field := self.deformation) is None:
            return self.values
        return deformed(self.values, self.required_grid, field, field.weights_at(time_s)[0])

    def moved_by(self, deformation: Deformation, subject: str) -> "Volume":
        """Returns the volume with another deformation. InputError, which names it by ``subject``, where it holds states."""
        if self.states is not None:
            found, expected = f"{subject}, which holds its states", "a volume whose object does not change"
            raise InputError("--object-motion", found, expected, "leave it out")
        return replace(self, deformation=deformation)

    @property
    def scale(self) -> Hounsfield | None:
        """The scale of Hounsfield units that the file holds, or None."""
        return of_facts(self.provenance)

    def hounsfield(self, air: Box | None = None, water: Box | None = None, insert_hu: float = 0.0) -> "Volume":
        """Returns the volume, still in 1/mm, with a scale of Hounsfield units. See ``hounsfield.fitted``."""
        scale = fitted(self.values, self.required_grid, air, water, insert_hu)
        return replace(self, provenance={**self.provenance, HOUNSFIELD: scale.facts()})

    def to_xarray(self) -> "DataArray":
        """Returns the values in 1/mm as xarray's DataArray with coordinates in mm. See ``Grid.data_array``."""
        return self.required_grid.data_array(self.values, "1/mm")

    @property
    def required_grid(self) -> Grid:
        """Returns the grid; InputError for a bare array."""
        if self.grid is None:
            raise InputError("volume", "values without voxel sizes", "a volume with its grid in mm")
        return self.grid


def write_volume(
    path: str | Path, volume: np.ndarray, grid: Grid, provenance: Mapping[str, object],
    gaussians: Gaussians | None = None, metrics: Mapping[str, object] | None = None,
    state: Mapping[str, np.ndarray] | None = None, deformation: Deformation | None = None, states: States | None = None,
    doubt: np.ndarray | None = None,
) -> None:
    """Writes a volume (nz, ny, nx) in 1/mm, whole or not at all. ``provenance`` and ``metrics`` are stored as JSON, plain
    values also as attributes; ``gaussians`` as float32; ``state``: arrays and texts from which an interrupted run resumes;
    ``deformation``: how the object moves; ``states``: the object at some times; ``doubt``: σ in 1/mm (nz, ny, nx).
    InputError: an array that is not finite or does not fit the grid. OutputError: the file cannot be written."""
    of_grid = {"volume": volume} if doubt is None else {"volume": volume, "doubt": doubt}
    for name, values in of_grid.items():
        checks.shape(name, values, grid.shape)
        checks.finite(name, values)
    arrays = [*of_grid.values(), *(state or {}).values(), *([] if gaussians is None else vars(gaussians).values())]
    arrays += [] if states is None else [states.volumes]
    with h5.new_hdf5(path, sum(values.nbytes for values in arrays)) as file:
        entry = h5.new_group(file, "entry", "NXentry")
        entry.attrs["default"] = "reconstruction"
        _write_data(entry, np.asarray(volume, np.float32), grid)
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
            _write_states(entry, states, grid)
        if state is not None:
            group = h5.new_group(entry, "state", "NXcollection")
            for name, values in state.items():
                group[name] = str(values) if values.dtype.kind == "U" else values


def read_volume(path: str | Path) -> Volume:
    """Reads a volume file, or a bare array /volume (z, y, x), which has no grid and whose integers are divided by the
    maximum of their type. InputError names the HDF5 path of the damage. Warns of damaged provenance, which is left out,
    and of a run that was interrupted."""
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
        values = _read_attenuation(source, _VOLUME, dataset)
        provenance, gaussians, metrics = _read_provenance(source), _read_gaussians(source), _read_metrics(source)
        deformation = None if source.find(DEFORMATION) is None else read_deformation_group(source, DEFORMATION)
        states = _read_states(source, grid.shape)
        if (sigma := source.optional(_DOUBT)) is not None:
            checks.shape(source.name(_DOUBT), sigma, grid.shape)
        doubt = None if sigma is None else _read_attenuation(source, _DOUBT, sigma)
        return Volume(values, grid, provenance, gaussians, metrics, deformation, states, doubt)


def read_state(path: str | Path) -> dict[str, np.ndarray] | None:
    """Reads the state from which an interrupted run resumes. None where there is none, and with a warning where it is
    damaged. The caller checks the arrays."""
    with open_hdf5(path) as source:
        try:
            group = source.optional_group(_STATE)
            return None if group is None else {name: _read_part(source, f"{_STATE}/{name}") for name in group}
        except InputError as error:
            log.warning("%s", error)
            return None


def check_attenuation(subject: str, volume: Volume, *, warn: bool = True) -> Volume:
    """Returns ``volume`` if rays can be sent through it. InputError about ``subject`` where the negative values outweigh
    the positive ones, as in Hounsfield units, and for values that no file of ours may hold; a warning where the negative
    values are more than a tenth."""
    values = volume.values
    if (size := float(np.abs(values).max())) > h5.ATTENUATION.largest:
        expected = f"attenuation of at most {h5.ATTENUATION.largest:g} 1/mm"
        raise InputError(subject, f"a value of size {size:.3g}", expected, "correct the value or its unit")
    positive = float(np.sum(values, where=values > 0, dtype=np.float64))
    negative = float(-np.sum(values, where=values < 0, dtype=np.float64))
    found = f"values from {values.min():g} to {values.max():g}"
    expected = "attenuation: 0 in air, above 0 in matter"
    remedy = "of Hounsfield units it is µ(water) (1 + HU / 1000)"
    if positive <= negative:
        raise InputError(subject, found, expected, remedy)
    if warn and negative > 0.1 * positive:
        share = f"{100 * negative / positive:.0f} % as much below 0 as above"
        log.warning("%s: %s, %s; expected %s; %s", subject, found, share, expected, remedy)
    return volume


def in_per_mm(subject: str, volume: Volume, mu_water_per_mm: float | None = None) -> Volume:
    """Returns a volume in 1/mm. Values that a file notes as Hounsfield units are converted by the scale in the note, or by
    water's attenuation; values beyond 10 by water's alone. The result then holds the scale. InputError about ``subject``
    for noted Hounsfield units without either."""
    stated = None if mu_water_per_mm is None else Hounsfield(mu_water_per_mm)
    is_hu, scale = of_note(str(volume.provenance.get(VALUES, "")))
    if scale is None and (is_hu or float(np.abs(volume.values).max()) > _USUAL_PER_MM):
        scale = stated
    if scale is not None:
        facts = {**volume.provenance, HOUNSFIELD: scale.facts(), VALUES: FROM_HU}
        return replace(volume, values=scale.per_mm(volume.values), provenance=facts)
    if is_hu:
        raise InputError(subject, "Hounsfield units", "1/mm", "say --mu-water-per-mm, near 0.02, to convert them")
    return volume


def words_of_hu(volumes: Mapping[Path, Volume], mu_water_per_mm: float | None = None) -> str:
    """Returns the names and scales of volumes that ``in_per_mm`` has converted, for the end of a line. InputError for
    water's attenuation that none of them needed."""
    scales = {path: one.scale for path, one in volumes.items() if one.provenance.get(VALUES) == FROM_HU}
    if mu_water_per_mm is not None and Hounsfield(mu_water_per_mm) not in scales.values():
        found = f"{mu_water_per_mm:g} for {' and '.join(map(str, volumes))}"
        expected = "a volume in Hounsfield units that does not state its scale"
        raise InputError("--mu-water-per-mm", found, expected, "leave it out")
    return "".join(f", {plain_text(path.name)} from HU ({scale.line})" for path, scale in scales.items() if scale)


def attenuation_of(subject: str, volume: Volume) -> Volume:
    """Returns the volume. InputError about ``subject`` for values that no attenuation in 1/mm has: those of CT numbers, and
    counts."""
    lowest, highest = float(volume.values.min()), float(volume.values.max())
    if lowest < _LOWEST_PER_MM or highest > _HIGHEST_PER_MM:
        found = f"values from {lowest:g} to {highest:g}, as of Hounsfield units"
        raise InputError(subject, found, "attenuation in 1/mm", "say --mu-water-per-mm, near 0.02, to convert them")
    return volume


def volume_summary(path: str | Path) -> dict[str, Any]:
    """Returns facts about a volume file without reading the voxels."""
    with open_hdf5(path) as source:
        _, grid = _dataset_and_grid(source)
        means = source.optional(f"{_GAUSSIANS}/mean") if source.optional_group(_GAUSSIANS) else None
        return {
            "shape": grid.shape, "voxel_size_mm": grid.voxel_size_mm, "offset_mm": grid.offset_mm,
            "provenance": _read_provenance(source), "metrics": _read_metrics(source),
            "gaussians": means.shape[0] if means is not None and means.ndim else 0,
            **_states_summary(source, grid.shape),
            "sha256": sha256_of(path),
        }


def read_states(path: str | Path) -> States | None:
    """Reads the object at some times from a volume file. None where the file has no states."""
    with open_hdf5(path) as source:
        return _read_states(source, _dataset_and_grid(source)[1].shape)


def _states_summary(source: Hdf5Source, shape: tuple[int, ...]) -> dict[str, object]:
    if source.optional_group(_STATES) is None:
        return {}
    times_s, _ = _states_datasets(source, shape)
    return {"states": len(times_s), "states_from_s": float(times_s[0]), "states_to_s": float(times_s[-1])}


def file_kind(path: str | Path) -> str:
    """Returns the kind of an HDF5 file: "scan", "volume", "plain-volume" (a bare dataset /volume) or "deformation", else
    InputError."""
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
    """Reads how a volume was made; warns, once per file, if its run was interrupted."""
    provenance = _read_facts(source, "provenance", PROVENANCE) or {}
    if where := interruption(provenance):
        of = "" if where["iterations_asked"] is None else f" of {where['iterations_asked']}"
        _warn_once(source.path, f"interrupted at iteration {where['interrupted_at']}{of}")
    return provenance


def interruption(provenance: Mapping[str, object]) -> dict[str, int | None]:
    """Returns ``interrupted_at`` and ``iterations_asked`` of an interrupted run; an empty table for any other."""
    at, options = provenance.get("interrupted_at"), provenance.get("options")
    if type(at) is not int:  # a bool is an int too
        return {}
    asked = options.get("iterations") if isinstance(options, Mapping) else None
    return {"interrupted_at": at, "iterations_asked": asked if type(asked) is int else None}


@cache
def _warn_once(path: Path, text: str) -> None:
    log.warning("%s: %s", path, text)


def _write_data(entry: h5py.Group, volume: np.ndarray, grid: Grid) -> None:
    group = h5.new_group(entry, "reconstruction", "NXdata")
    group.attrs["signal"], group.attrs["axes"] = "volume", list(_AXES)
    group["title"] = "attenuation (1/mm)"
    _write_attenuation(group, "volume", volume, "attenuation (1/mm)")
    _write_axes(group, grid)


def _write_attenuation(group: h5py.Group, name: str, values: np.ndarray, words: str, **how: Any) -> None:
    dataset = group.create_dataset(name, data=np.asarray(values, np.float32), **how)
    dataset.attrs.update(units="1/mm", long_name=words, interpretation="image")


def _write_axes(group: h5py.Group, grid: Grid) -> None:
    for name, centres_mm in zip(_AXES, grid.axes_mm(), strict=True):
        h5.write_number(group, name, centres_mm, "mm", long_name=f"{name} (mm)")


def _write_states(entry: h5py.Group, states: States, grid: Grid) -> None:
    group = h5.new_group(entry, "time_series", "NXdata")
    group.attrs["signal"], group.attrs["axes"] = "volume", ["time_s", *_AXES]
    group["title"] = "attenuation (1/mm) at some times"
    _write_attenuation(group, "volume", states.volumes, "attenuation (1/mm)", chunks=(1, *grid.shape))
    h5.write_number(group, "time_s", states.times_s, "s", long_name="time (s)")
    _write_axes(group, grid)


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
    """Derives the grid from the centres of the voxels along each axis."""
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
    usual = next((step for step in steps_mm if step is not None), 1.0)  # an axis of one voxel has no spacing
    return Grid(triple(shape), triple(usual if s is None else s for s in steps_mm), triple(centres_mm))


def _read_states(source: Hdf5Source, shape: tuple[int, ...]) -> States | None:
    if source.optional_group(_STATES) is None:
        return None
    times_s, dataset = _states_datasets(source, shape)
    return States(times_s, _read_attenuation(source, f"{_STATES}/volume", dataset))


def _states_datasets(source: Hdf5Source, shape: tuple[int, ...]) -> tuple[np.ndarray, h5py.Dataset]:
    """Returns the times (K,) in s of states, and their dataset. InputError for times that do not rise, and other shapes."""
    times_s = h5.read_array(source, f"{_STATES}/time_s", (None,), h5.TIME)
    if len(times_s) == 0 or (np.diff(times_s) <= 0).any():
        raise source.error(f"{_STATES}/time_s", checks.short_repr(times_s.tolist()), "at least one time, rising")
    dataset = source.dataset(f"{_STATES}/volume")
    checks.shape(source.name(f"{_STATES}/volume"), dataset, (len(times_s), *shape))
    return times_s, dataset


def _read_attenuation(source: Hdf5Source, address: str, dataset: h5py.Dataset) -> np.ndarray:
    """Reads finite float32 in 1/mm."""
    values = h5.read_values(source, address, dataset)
    checks.finite(source.name(address), values)
    return h5.in_unit(source, address, values, h5.ATTENUATION).astype(np.float32)


def shares_of_maximum(values: np.ndarray) -> np.ndarray:
    """Returns integers divided by the maximum of their type, in float32, and other numbers unchanged."""
    return values / np.float32(np.iinfo(values.dtype).max) if values.dtype.kind in "iu" else values


def finite_float32(subject: str, values: np.ndarray) -> np.ndarray:
    """Returns ``values`` as contiguous float32; InputError about ``subject`` where one is not finite."""
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
    """Reads numbers by name; other values are left out with a warning."""
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
