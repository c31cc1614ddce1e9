"""A run as one value: its method, options, preprocessing, seed and first volume, and how the object moves. The command line,
configuration files, the API, sweeps all make it with ``plan_run``."""

import hashlib
import logging
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, triple
from phyradgs_cl.reconstructors.method import DEFAULT_METHOD, METHODS, method_name, method_of
from phyradgs_cl.reconstructors.options import method_options, preprocessing_names, preprocessing_of
from phyradgs_cl.reconstructors.preprocess import Preprocessing
from phyradgs_cl.reconstructors.result import option_facts

LARGEST_SEED = 2**63
_DECIMALS = 6  # of mm and s: a scan that went through a file is still the same scan
_SUBJECT = "--object-motion"
_MOST_VOXELS = 24  # along a side of the grid on which a deformation is looked at
_LEAST_DETERMINANT = 0.05
_LEAST_COVERED, _MOSTLY_COVERED = 0.5, 0.98  # of the scan, by the times of a deformation: below the first it is refused
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class InitialVolume:
    """A volume (nz, ny, nx) in 1/mm from which a method starts, and its grid. facts: which file holds it, for provenance."""

    values: np.ndarray
    grid: Grid
    facts: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """How the object moves during the scan. facts: which file holds it, for provenance."""

    deformation: Deformation
    facts: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RunPlan:
    """What to run on a scan. method: a name as from ``method_name``, or a function of the user's own. options: the method's,
    checked. preprocessing: what happens to the frames first. Raises InputError for a seed out of range, and for an object
    that moves with a method that takes it to be at rest."""

    method: "str | Callable[..., Any]"
    options: Any
    preprocessing: Preprocessing = Preprocessing()
    seed: int = 0
    initial: InitialVolume | None = None
    object_motion: ObjectMotion | None = None

    def __post_init__(self) -> None:
        checks.whole("--seed", self.seed, 0, LARGEST_SEED)
        if self.object_motion is not None and not method_of(self.method).takes_deformation:
            names = ", ".join(name for name, method in METHODS.items() if method.takes_deformation)
            expected = f"a method whose object may move: {names}"
            raise InputError("--object-motion", f"--method {self.method_name}", expected, "choose one of them")

    @property
    def method_name(self) -> str:
        """The method's name; of a function ``module:name``."""
        return method_name(self.method)

    def identity(self, scan: Scan) -> dict[str, Any]:
        """Returns everything that a run must share with the interrupted one that it continues. Reads all frames."""
        grid = scan.grid
        return {
            "scan": _digest(scan.projections, np.packbits(scan.valid), *_geometry(scan)),
            "grid": [grid.shape, *(np.round(three, _DECIMALS).tolist() for three in (grid.voxel_size_mm, grid.offset_mm))],
            "method": self.method_name,
            "seed": self.seed,
            "input": self.preprocessing.facts(),
            **option_facts(self.options),
            "initial": None if self.initial is None else _digest(self.initial.values.astype(np.float32)),
            **({} if self.object_motion is None else {"object_motion": _deformation_digest(self.object_motion.deformation)}),
        }


def _geometry(scan: Scan) -> Iterator[np.ndarray]:
    """Yields when every frame is taken, and the poses at its start and its end."""
    yield np.round(scan.frame_start_s, _DECIMALS)
    span_s = np.array([0.0, scan.shutter.span_s])
    for frame, start_s in enumerate(scan.frame_start_s):
        yield np.round(scan.trajectory.pose(frame, start_s + span_s), _DECIMALS) + 0.0  # + 0.0 makes a 0 of a -0


def _deformation_digest(one: Deformation) -> str:
    return _digest(one.control_mm, np.array([one.origin_mm, one.spacing_mm]), one.times_s, one.weights)


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:16]


def plan_run(
    method: object = DEFAULT_METHOD, values: Mapping[str, Any] | None = None, *, preset: str | None = None,
    seed: int = 0, initial: InitialVolume | None = None, object_motion: ObjectMotion | None = None,
    of_preprocessing: Collection[str] = (),
) -> RunPlan:
    """Returns the plan of a run: ``values`` by name over the method's preset.

    A name that both the method and the preprocessing have is the method's, except those in ``of_preprocessing``.
    Raises InputError for a method, preset, option or value that does not exist."""
    own = dict(values or {})
    names = [*preprocessing_names(method, preset), *of_preprocessing]
    preprocessing = preprocessing_of({name: own.pop(name) for name in names if name in own})
    options = method_options(method, preset, own)
    checks.whole("--seed", seed, 0, LARGEST_SEED)
    named = method if callable(method) else method_name(method)
    return RunPlan(named, options, preprocessing, int(seed), initial, object_motion)


def check_object_motion(deformation: Deformation, scan: Scan) -> None:
    """Raises InputError for a deformation of another place, another time or another unit than the scan's, and where matter
    folds or is compressed to nothing."""
    _check_times(deformation, scan)
    grid = scan.grid.in_shape(triple(min(n, _MOST_VOXELS) for n in scan.grid.shape))
    if not deformation.control_mm.any():
        return
    fields_mm = np.stack([deformation.on_grid_mm(grid, unit) for unit in np.eye(deformation.rank)])
    lengths_mm = np.linalg.norm(fields_mm, axis=-1).max(axis=(1, 2, 3))
    reach_mm = float((np.abs(deformation.weights).max(axis=0) * lengths_mm).sum())
    if reach_mm == 0:
        box_mm = np.round(scan.grid.box_mm, 3).tolist()
        remedy = "check the origin and the unit of its control points"
        found = "a deformation that moves nothing in the scan's grid"
        raise InputError(_SUBJECT, found, f"one in {box_mm} mm (z, y, x)", remedy)
    if reach_mm > max(scan.grid.size_mm):
        found = f"displacements of up to {reach_mm:.3g} mm in a box of {max(scan.grid.size_mm):.3g} mm"
        raise InputError(_SUBJECT, found, "displacements within the box", "check the unit of its control vectors")
    if (determinant := deformation.smallest_determinant(grid)) < _LEAST_DETERMINANT:
        found = f"matter that folds: a smallest determinant of {determinant:.3g}"
        raise InputError(_SUBJECT, found, f"at least {_LEAST_DETERMINANT:g}", "use a smoother or smaller field")


def _check_times(deformation: Deformation, scan: Scan) -> None:
    times_s = deformation.times_s
    if len(times_s) == 1:
        return
    first_s, last_s = float(scan.frame_start_s.min()), float(scan.frame_start_s.max() + scan.shutter.span_s)
    covered_s = min(times_s[-1], last_s) - max(times_s[0], first_s)
    found = f"times from {times_s[0]:.4g} to {times_s[-1]:.4g} s for a scan from {first_s:.4g} to {last_s:.4g} s"
    if covered_s < _LEAST_COVERED * (last_s - first_s):
        raise InputError(_SUBJECT, found, "times that cover the scan", "check their unit and where they begin")
    if covered_s < _MOSTLY_COVERED * (last_s - first_s):
        log.warning("%s: found %s; the object rests before and after them, displaced as at their ends", _SUBJECT, found)
