"""Estimates errors of single views (a wobble), or a slow motion of the object as splines of time.

A view's parameters change only its own frame, so their signals (columns of the Jacobian) are images of that frame. CGLS
solves the normal equations of a Gauss–Newton step for the volume and all parameters together. Parameters then explain only
what the volume cannot. ``estimate_views`` takes such steps from coarse to fine grids."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import start_azimuths_rad
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, Sway, Views, splines
from phyradgs_cl.calibrate.problem import CoarseProblem, PassCounter, Passes, Stage, pass_cost
from phyradgs_cl.calibrate.result import AGREES, CORRECTED, ParameterEstimate
from phyradgs_cl.detector import noise_level
from phyradgs_cl.operators.rays.operator import RayOperator
from phyradgs_cl.reconstructors.fits.residuals import AugmentedOperator, ViewParameters
from phyradgs_cl.reconstructors.voxels.cgls import Cgls
from phyradgs_cl.runtime import Runtime

SPLINES = 7  # default number of cubic splines over the scan's time
TURN, SHIFT_V, SHIFT_U = 0, 1, 2
_STEP_PX = 0.25  # a central difference moves a frame by this many coarse pixels to each side
_LEAST_NORM = 0.1  # a signal is divided by its norm, or by this fraction of the largest norm of its kind if that is larger
_DEG = float(np.rad2deg(1.0))
# (Discretisation error of a value) / (its change since the next coarser grid). With voxels half as large, 1 suits errors
# ∝ voxel size, and 1/3 suits errors ∝ (voxel size)².
DISCRETISATION = 0.5
_STEPS = 3  # number of Gauss–Newton steps on each grid
_ITERATIONS = 20  # number of CGLS iterations for each step, and for each standard deviation
_DEVIATIONS = 3.0  # a kind of parameter is corrected only if its RMS over the views exceeds this many standard deviations


@dataclass(frozen=True, eq=False)
class PerViewParameters(ABC):
    """Parameters of F views: K kinds with n coefficients ``values`` (n, K). View f has (``basis`` @ ``values``)[f], (K,).

    - basis (F, n). units (K,): the value of each kind, in rad or mm, that moves a frame's edge by a pixel.
    - circle (n, 2): coefficients of the cosine and sine of the gantry's angle, as far as the basis allows.
    - KINDS: name and unit, deg or mm, of each kind in the table of estimates.
    - MISMATCH: (measured errors) / (errors by noise alone), see docs/calibrate.md. Errors of voxels cause the difference.
    - FINE: kinds that need fine detail. Only the last two grids estimate them. Both start from 0, so that the difference
      between the two shows their error."""

    values: np.ndarray
    basis: np.ndarray
    units: np.ndarray
    circle: np.ndarray

    KINDS: ClassVar[tuple[tuple[str, str], ...]]
    MISMATCH: ClassVar[float]
    FINE: ClassVar[tuple[int, ...]] = ()

    @abstractmethod
    def views_of(self, values: np.ndarray) -> Views | Sway:
        """Returns the change of a scan's views, or of its object's pose, that the coefficients ``values`` (n, K) mean."""

    @abstractmethod
    def without_gauges(self, values: np.ndarray) -> np.ndarray:
        """Returns coefficients (n, K) without the part that another object would explain exactly."""

    def kinds_of_stage(self, number: int, count: int) -> Sequence[int]:
        """Returns the indices of the kinds to estimate in stage ``number`` of ``count``."""
        return [kind for kind in range(len(self.KINDS)) if kind not in self.FINE or number >= count - 2]

    def operator(
        self, problem: CoarseProblem, correction: GeometryCorrection, more: np.ndarray | float = 0.0
    ) -> RayOperator:
        return problem.operator(correction, self.views_of(self.values + more))


class WobbleParameters(PerViewParameters):
    """One turn (rad) and two shifts, along v and u (mm), per view: separate for each view, or as splines of time."""

    KINDS = (("turn per view", "deg"), ("shift-v per view", "mm"), ("shift-u per view", "mm"))
    MISMATCH = 4.0
    FINE = (TURN,)

    @classmethod
    def of(cls, scan: Scan, count: int = 0) -> "WobbleParameters":
        """Returns a wobble of 0 in ``count`` splines of time, or with separate parameters of each view if ``count`` is 0."""
        if count:
            starts_s = np.asarray(scan.frame_start_s) - np.min(scan.frame_start_s)
            basis = splines(starts_s / max(starts_s.max(), 1e-30), count)
            circle = _fitted_circle(scan, basis)
        else:
            basis, circle = np.eye(scan.frames), _circle(scan)
        return cls(np.zeros((basis.shape[1], len(cls.KINDS))), basis, units_of_views(scan), circle)

    def views_of(self, values: np.ndarray) -> Views:
        per_view = self.basis @ values
        return Views(per_view[:, TURN], per_view[:, SHIFT_V:])

    def without_gauges(self, values: np.ndarray) -> np.ndarray:
        """Returns values (n, K) without what a turned or shifted object explains: the means of turns and of shifts along v,
        and shifts along u that vary as cosine and sine of the angle."""
        rest = values.copy()
        rest[:, :SHIFT_U] -= (self.basis @ rest[:, :SHIFT_U]).mean(0)
        pattern, shifts = self.basis @ self.circle, self.basis @ rest[:, SHIFT_U]
        rest[:, SHIFT_U] -= self.circle @ np.linalg.lstsq(pattern, shifts, rcond=None)[0]
        return rest


@dataclass(frozen=True, eq=False)
class MotionParameters(PerViewParameters):
    """Three turns (rad) and three shifts (mm) of the object about and along x, y, z, as splines of time."""

    still: Sway

    KINDS = (
        *((f"turn about {axis} of the object", "deg") for axis in "xyz"),
        *((f"shift along {axis} of the object", "mm") for axis in "xyz"),
    )
    MISMATCH = 7.0

    @classmethod
    def of(cls, scan: Scan, count: int = SPLINES) -> "MotionParameters":
        """Returns an object at rest: ``count`` splines of time with coefficients of 0."""
        still = Sway.none(scan, count)
        basis = still.basis(np.asarray(scan.frame_start_s) + scan.shutter.middle_s)
        shift_mm = scan.geometry.pixel_size_mm[1] / scan.geometry.magnification
        units = np.array([_turn_unit_rad(scan)] * 3 + [shift_mm] * 3)
        return cls(still.coefficients, basis, units, _fitted_circle(scan, basis), still)

    def views_of(self, values: np.ndarray) -> Sway:
        return replace(self.still, coefficients=values)

    def without_gauges(self, values: np.ndarray) -> np.ndarray:
        """Returns values (n, K) without the part that an object at rest would explain as well. An object that is turned or
        shifted explains the mean of each turn and shift over the views. A larger or smaller object explains shifts along x
        and y in proportion to the source's position."""
        rest = values - (self.basis @ values).mean(0)
        towards_source = self.circle - (self.basis @ self.circle).mean(0)
        shifts, pattern = self.basis @ rest[:, 3:5], self.basis @ towards_source
        rest[:, 3:5] -= np.sum(shifts * pattern) / np.sum(pattern**2) * towards_source
        return rest


def _turn_unit_rad(scan: Scan) -> float:
    edge_mm = max(scan.grid.size_mm[1:]) / 2 * scan.geometry.magnification
    return scan.geometry.pixel_size_mm[1] / edge_mm


def units_of_views(scan: Scan) -> np.ndarray:
    """Returns (3,): the turn in rad, and the shifts along v and u in mm, that each move a frame's edge by a pixel."""
    return np.array([_turn_unit_rad(scan), *scan.geometry.pixel_size_mm])


def _circle(scan: Scan) -> np.ndarray:
    """Returns cosine and sine (F, 2) of the views' angles."""
    azimuth_rad = start_azimuths_rad(scan)
    return np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], -1)


def _fitted_circle(scan: Scan, basis: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(basis, _circle(scan), rcond=None)[0]


def view_step(
    problem: CoarseProblem, correction: GeometryCorrection, parameters: PerViewParameters, volume: np.ndarray,
    kinds: Sequence[int], iterations: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a Gauss–Newton step (n, K) of the parameters at the object ``volume``, 0 for kinds not in ``kinds``. Also
    returns signals (F, kinds, rows, columns): each frame's derivative by its view's parameters, per pixel of movement."""
    operator = parameters.operator(problem, correction)
    residual = problem.residual(operator, volume)
    signals = np.stack([_signal(problem, correction, parameters, volume, kind) for kind in kinds], 1)
    norms = _norms(parameters.basis, signals)
    scale = _strength(operator) / np.maximum(norms, _LEAST_NORM * norms.max(0))
    if not np.array_equal(parameters.basis, np.eye(len(signals))):
        # Several splines act on a view, but its signal can have only one scale: all splines share the mean scale.
        scale = np.broadcast_to(scale.mean(0), scale.shape)
    per_view = parameters.basis @ scale / parameters.basis.sum(1, keepdims=True)
    scaled = (signals * per_view[:, :, None, None]).astype(np.float32)
    views = ViewParameters(scaled, parameters.basis)
    augmented = AugmentedOperator(operator, views)
    method = Cgls(augmented.system(residual, problem.valid))
    for _ in range(iterations):
        method.step()
        problem.count_pass()
    step = np.zeros(parameters.values.shape)
    _, values = augmented.parts(method.volume)
    step[:, kinds] = views.parts(values) * scale * parameters.units[list(kinds)]
    return step, signals


def view_deviations(
    problem: CoarseProblem, correction: GeometryCorrection, parameters: PerViewParameters,
    signals: np.ndarray, iterations: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns for each kind the standard deviation (K,) of a view's parameter, in rad or mm, and the fraction (K,) of its
    signals that no object explains.

    signals (F, K, rows, columns): each frame's derivative by its view's parameter of each kind, per pixel of movement. A
    view's value is a sum over spline coefficients, whose errors count as independent."""
    operator = parameters.operator(problem, correction)
    norms = _norms(parameters.basis, signals)
    noise = noise_level(problem.measured, problem.valid)
    kinds = range(signals.shape[1])
    shares = np.array([_share(problem, operator, parameters.basis, signals[:, k], iterations) for k in kinds])
    weight = np.sqrt(np.mean(np.sum(parameters.basis**2, 1)))
    deviations = parameters.MISMATCH * weight * noise / (shares * np.median(norms, 0) + 1e-30) * parameters.units
    return deviations, shares


def _norms(basis: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Returns the norms (n, K) of the columns d(frames)/d(coefficient) of the Jacobian. basis: (F, n). signals (F, K, rows,
    columns): each frame's derivative per pixel of movement."""
    return np.sqrt(basis.T**2 @ np.sum(np.square(signals, dtype=np.float64), (2, 3)))


def _strength(operator: RayOperator) -> float:
    """Estimates the largest singular value of the projector, in mm. CGLS finds parameters as fast as the volume if their
    signals are scaled to this norm."""
    lengths = operator.forward(np.ones(operator.volume_shape, np.float32))
    return float(np.linalg.norm(operator.adjoint(lengths)) / np.linalg.norm(lengths))


def _signal(
    problem: CoarseProblem, correction: GeometryCorrection, parameters: PerViewParameters, volume: np.ndarray,
    kind: int,
) -> np.ndarray:
    """Returns each frame's derivative (F, rows, columns) by its view's parameter of ``kind``, per pixel of movement."""
    step_px = _STEP_PX * problem.block
    step = np.zeros(len(parameters.units))
    step[kind] = step_px * parameters.units[kind]
    ends = [parameters.operator(problem, correction, sign * step).forward(volume) for sign in (1, -1)]
    return problem.masked((ends[0] - ends[1]) / np.float32(2 * step_px))


def _share(
    problem: CoarseProblem, operator: RayOperator, basis: np.ndarray, signals: np.ndarray, iterations: int
) -> float:
    """Returns norm(part that no object explains) / norm(whole), 0 to 1, of a random change of the frames: the ``signals``
    (F, rows, columns) of one kind times the views' values by random coefficients 1 or −1 of the ``basis`` (F, n)."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], basis.shape[1]).astype(np.float32)
    probe = signals * (basis @ signs).astype(np.float32)[:, None, None]
    (rest,) = problem.beyond_object(operator, np.zeros(operator.volume_shape, np.float32), [probe], iterations)
    return float(np.linalg.norm(rest) / max(float(np.linalg.norm(probe)), 1e-30))


@dataclass(frozen=True, eq=False)
class ViewsEstimate:
    """The result of ``estimate_views``. views: the corrections, 0 for kinds that are not significant; None if no kind is.
    table: an estimate per kind; its value is the kind's root mean square over the views."""

    views: Views | Sway | None
    table: list[ParameterEstimate]


def passes_of_views(scan: Scan, stages: Sequence[Stage], kinds: int) -> Passes:
    """Returns how many passes through the frames ``estimate_views`` makes, and their total cost (``pass_cost``)."""
    costs = [pass_cost([scan], stage.columns, scan.frames) for stage in stages]
    counts = [stage.first + (_STEPS - 1) * stage.again + _STEPS * _ITERATIONS for stage in stages]
    counts[-1] += kinds * _ITERATIONS
    return sum(counts), sum(cost * count for cost, count in zip(costs, counts, strict=True))


def estimate_views(
    rt: Runtime, scan: Scan, parameters: PerViewParameters, stages: Sequence[Stage],
    correction: GeometryCorrection, passes: PassCounter,
) -> ViewsEstimate:
    """Estimates ``parameters`` of a scan after ``correction``, by three Gauss–Newton steps on each grid, coarse to fine.

    A standard deviation combines noise and discretisation error. The latter is half the value's change since the coarser
    grid, or 0 for a kind that the coarser grid did not estimate."""
    for number, stage in enumerate(stages):
        problem = CoarseProblem.of(rt, [scan], stage, scan.frames)
        problem = replace(problem, count_pass=passes.counter(pass_cost([scan], stage.columns, scan.frames)))
        compared = problem.without_cut_ends()
        former, volume = parameters.values, None
        is_kept = ~np.isin(np.arange(len(parameters.KINDS)), parameters.FINE)
        parameters = replace(parameters, values=former * is_kept)
        kinds = parameters.kinds_of_stage(number, len(stages))
        for _ in range(_STEPS):
            operator = parameters.operator(problem, correction)
            volume = problem.reconstruct(operator, volume, stage.first if volume is None else stage.again)
            step, signals = view_step(compared, correction, parameters, volume, kinds, _ITERATIONS)
            parameters = replace(parameters, values=parameters.without_gauges(parameters.values + step))
    noise, shares = view_deviations(compared, correction, parameters, signals, _ITERATIONS)
    change = _rms_over_views(parameters, parameters.values - former)
    kinds_before = parameters.kinds_of_stage(len(stages) - 2, len(stages)) if len(stages) > 1 else []
    was_estimated = np.isin(np.arange(len(parameters.KINDS)), kinds_before)
    deviations = np.hypot(noise, DISCRETISATION * change * was_estimated)
    sizes = _rms_over_views(parameters, parameters.values)
    is_significant = sizes > _DEVIATIONS * deviations
    table = []
    for k, (name, unit) in enumerate(parameters.KINDS):
        size, deviation = (float(values[k] * (_DEG if unit == "deg" else 1.0)) for values in (sizes, deviations))
        verdict = CORRECTED if is_significant[k] else AGREES
        table.append(ParameterEstimate(name, unit, 0.0, size, deviation, float(shares[k]), verdict))
    views = parameters.views_of(parameters.values * is_significant) if is_significant.any() else None
    return ViewsEstimate(views, table)


def _rms_over_views(parameters: PerViewParameters, values: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.square(parameters.basis @ values), 0))
