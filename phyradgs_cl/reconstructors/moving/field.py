"""Improves the displacement field of a moving object by steps of Gauss-Newton, at a given volume.

    min over U, φ of ‖p − Σ_k P_k W_k v‖² + γ bending(U) + β roughness(φ)

p: frames. W_k deforms the volume v to state k, which is the object near one time, and P_k projects state k. U: control
vectors of the fields. φ: spline coefficients of the fields' weights in time. Steps of U and of φ alternate. A step is taken
only if it lowers the sum and the stepped field does not fold matter."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Deformation, control_points
from phyradgs_cl.fields.deformation import fitted_control_mm
from phyradgs_cl.operators.rays.subrays import subrays_of
from phyradgs_cl.operators.warp.operator import FieldDerivative, WarpedOperator
from phyradgs_cl.operators.warp.states import MotionStates
from phyradgs_cl.operators.warp.volume import StateStack, VolumeWarp
from phyradgs_cl.reconstructors.moving.signal import Bending, TemporalSplines
from phyradgs_cl.runtime import Runtime

_CG_STEPS = 8  # iterations of conjugate gradients for one step of the control vectors
_DAMPING = 1e-3  # (Levenberg damping)/(mean diagonal of JᵀJ), J: derivative of frames; control points without rays need it
_ROUGHNESS = 1e-2  # β, weight of the roughness in time, relative to the mean diagonal of JᵀJ (J: derivative of frames)
_SHORTER = (1.0, 0.5, 0.25)  # backtracking line search: fractions of a step, tried in turn until one lowers the objective
_LEAST_DETERMINANT = 0.1  # least det(I + ∂w/∂y) of the displacement w(y) after a step: at 0 matter folds
_LEAST_VOXELS = 1.0  # if a field's weight in time changes by 1, matter counts as moved by at least this many voxels
_SUPPORT = 4  # number of intervals between knots over which a cubic spline in time extends


@dataclass(frozen=True, eq=False)
class MotionField:
    """A displacement field during its search: R fields in space, each times a weight in time. control_mm: the fields'
    control vectors (R, cz, cy, cx, 3). control_mm, origin_mm, spacing_mm: as in ``Deformation``. temporal (count, R):
    coefficients by which the ``count`` splines in time sum to the R weights."""

    control_mm: np.ndarray
    origin_mm: tuple[float, float, float]
    spacing_mm: float
    splines: TemporalSplines
    temporal: np.ndarray

    @classmethod
    def at_rest(cls, scan: Scan, spacing_mm: float, splines: TemporalSplines, temporal: np.ndarray) -> "MotionField":
        """Returns a field of zeros over the scan's grid, with coefficients ``temporal`` (count, R) of weights in time. The
        weights are shifted to mean 0 and scaled to largest size 1."""
        origin_mm, counts = control_points(scan.grid, spacing_mm)
        centred = temporal - splines.at(splines.node_times_s).mean(0) @ temporal  # splines sum to 1: the weights get mean 0
        control_mm = np.zeros((temporal.shape[1], *counts, 3))
        return cls(control_mm, origin_mm, spacing_mm, splines, centred).scaled()

    def deformation(self) -> Deformation:
        times_s = self.splines.node_times_s
        weights = self.splines.at(times_s) @ self.temporal
        return Deformation(self.control_mm, self.origin_mm, self.spacing_mm, times_s, weights)

    def scaled(self) -> "MotionField":
        """Returns the same displacements, with each field's weight scaled to a largest size of 1."""
        largest = np.abs(self.splines.at(self.splines.node_times_s) @ self.temporal).max(0)
        factor = np.where(largest > 0, largest, 1.0)
        control_mm = self.control_mm * factor[:, None, None, None, None]
        return replace(self, control_mm=control_mm, temporal=self.temporal / factor)

    def refined(self, scan: Scan, spacing_mm: float) -> "MotionField":
        """Returns the field on closer control points, ``spacing_mm`` apart, fitted to its displacements at the voxels."""
        coarse = self.deformation()
        units_mm = np.stack([coarse.on_grid_mm(scan.grid, unit) for unit in np.eye(coarse.rank)])
        control_mm, origin_mm = fitted_control_mm(units_mm, scan.grid, spacing_mm)
        return replace(self, control_mm=control_mm, origin_mm=origin_mm, spacing_mm=spacing_mm)


@dataclass(eq=False)
class FieldProblem:
    """The misfit ‖frames − projections of a volume‖², as a function of the object's displacement field. motion: the gantry's
    motion model. bending: γ, weight of the field's bending, relative to how strongly frames respond to a control vector."""

    rt: Runtime
    scan: Scan
    motion: Motion
    bending: float
    tables: list[TimeCells] = field(init=False)
    times_s: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.tables = [self.motion.cells(self.scan, f).still() for f in range(self.scan.frames)]
        self.times_s = np.concatenate([table.time_s for table in self.tables])

    @property
    def measured(self) -> np.ndarray:
        """The frames (F, rows, columns), 0 at pixels that are not valid."""
        return self._masked(self.scan.projections)

    def operator(
        self, one: MotionField, tables: list[TimeCells] | None = None, warp: VolumeWarp | StateStack | None = None
    ) -> WarpedOperator:
        """Returns the projector A of an object that moves by the field ``one``. warp: that of an earlier projector, to save
        its computation. tables: time cells in place of the scan's, at the same times."""
        if warp is None:
            states = MotionStates.of_times(one.deformation(), self.scan.grid, self.times_s, _LEAST_VOXELS)
            warp = VolumeWarp(self.rt, states)
        shape = self.scan.geometry.detector_shape
        tables = tables or self.tables
        subrays = subrays_of(self.scan.grid, tables)
        return WarpedOperator(self.rt, self.scan.grid, shape, tables, warp=warp, subrays=subrays)

    def residual(self, one: MotionField, volume: np.ndarray) -> np.ndarray:
        """Returns frames − projections of ``volume`` under the field ``one``, (F, rows, columns); 0 where not valid."""
        return self._masked(self.scan.projections - self.operator(one).forward(volume))

    def space_step(self, one: MotionField, volume: np.ndarray) -> MotionField:
        """Returns the field after a step of its control vectors; the field itself if no step lowers misfit + bending."""
        operator = self.operator(one)
        residual = self._masked(self.scan.projections - operator.forward(volume))
        derivative = FieldDerivative(operator, volume)

        def normal(change: np.ndarray) -> np.ndarray:
            return derivative.adjoint(self._masked(derivative.forward(change)))

        # penalties are relative to the mean diagonal of JᵀJ, which a vector of random signs estimates (Hutchinson)
        probe = np.random.default_rng(0).choice([-1.0, 1.0], one.control_mm.shape)
        response = float(np.vdot(probe, normal(probe))) / probe.size
        if not response > 0:
            return one
        bend, weight = Bending(one.control_mm.shape[1:4]), self.bending * response

        def system(change: np.ndarray) -> np.ndarray:
            return normal(change) + weight * bend(change) + _DAMPING * response * change

        def penalty(other: MotionField) -> float:
            return weight * float(np.vdot(other.control_mm, bend(other.control_mm)))

        downhill = derivative.adjoint(residual) - weight * bend(one.control_mm)
        step = conjugate_gradients(system, downhill, _CG_STEPS)
        candidates = (replace(one, control_mm=one.control_mm + share * step) for share in _SHORTER)
        return self._first_better(one, residual, candidates, volume, penalty)

    def time_step(self, one: MotionField, volume: np.ndarray) -> MotionField:
        """Returns the field after a step of its weights in time; the field itself if no step lowers misfit + roughness."""
        operator = self.operator(one)
        residual = self._masked(self.scan.projections - operator.forward(volume))
        hessian, downhill = self._temporal_equations(one, operator, volume, residual)
        count, rank = one.temporal.shape
        responses = [float(np.trace(hessian[:, r, :, r])) / count for r in range(rank)]
        if not min(responses) > 0:
            return one
        smooth, rough = np.zeros_like(hessian), one.splines.roughness()
        for r, response in enumerate(responses):
            smooth[:, r, :, r] = _ROUGHNESS * response * rough
        damping = np.diag(np.tile(_DAMPING * np.array(responses), count))
        square, size = smooth.reshape(count * rank, -1), count * rank
        now = one.temporal.ravel()
        step = np.linalg.solve(hessian.reshape(size, size) + square + damping, downhill.ravel() - square @ now)

        def penalty(other: MotionField) -> float:
            return float(other.temporal.ravel() @ square @ other.temporal.ravel())

        candidates = (replace(one, temporal=one.temporal + share * step.reshape(count, rank)) for share in _SHORTER)
        return self._first_better(one, residual, candidates, volume, penalty).scaled()

    def _temporal_equations(
        self, one: MotionField, operator: WarpedOperator, volume: np.ndarray, residual: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the normal equations of the coefficients in time: JᵀJ (count, R, count, R), and Jᵀ r (count, R), with the
        frames' derivative J and the residual r (F, rows, columns).

        One projection serves several splines if no frame sees two of them."""
        count, rank = one.temporal.shape
        spans_s = max(float(np.ptp(table.time_s)) for table in self.tables)
        # splines of one colour lie so far apart in time that a frame sees at most one of them: they share a projection
        colours = min(count, _SUPPORT + int(np.ceil(spans_s / one.splines.step_s)) + 1)
        values = [one.splines.at(table.time_s) for table in self.tables]
        derivative = FieldDerivative(operator, volume)
        frames = np.empty((colours, rank, *residual.shape), np.float32)
        owners = np.full((self.scan.frames, colours), -1)
        for colour in range(colours):
            members = np.arange(colour, count, colours)
            tables = [
                replace(table, weight=table.weight * value[:, members].sum(1))
                for table, value in zip(self.tables, values, strict=True)
            ]
            for f, value in enumerate(values):
                seen = members[value[:, members].any(0)]
                owners[f, colour] = seen[0] if seen.size else -1
            derivative.operator = self.operator(one, tables, operator.warp)
            frames[colour] = [self._masked(each) for each in derivative.by_weights()]
        hessian, downhill = np.zeros((count, rank, count, rank)), np.zeros((count, rank))
        for f in range(self.scan.frames):
            chosen = np.flatnonzero(owners[f] >= 0)
            places, responses = owners[f, chosen], frames[chosen, :, f].astype(np.float64)
            products = np.einsum("arvu,bsvu->abrs", responses, responses, optimize=True)
            for row, a in enumerate(places):
                downhill[a] += np.einsum("rvu,vu->r", responses[row], residual[f])
                for column, b in enumerate(places):
                    hessian[a, :, b] += products[row, column]
        return hessian, downhill

    def _first_better(
        self, one: MotionField, residual: np.ndarray, candidates: Iterable[MotionField], volume: np.ndarray,
        penalty: Callable[[MotionField], float],
    ) -> MotionField:  # fmt: skip
        """Returns the first field of ``candidates`` that does not fold matter and has a smaller ‖residual‖² + ``penalty``
        than the field ``one``; if none has, ``one``. residual: that of ``one``."""
        before = sum_squares(residual) + penalty(one)
        for candidate in candidates:
            # a field that folds matter has no inverse, so it is left out however well its frames fit
            if candidate.deformation().smallest_determinant() < _LEAST_DETERMINANT:
                continue
            if sum_squares(self.residual(candidate, volume)) + penalty(candidate) < before:
                return candidate
        return one

    def _masked(self, frames: np.ndarray) -> np.ndarray:
        return np.asarray(np.where(self.scan.valid, frames, np.float32(0)))


def sum_squares(values: np.ndarray) -> float:
    return float(np.square(values, dtype=np.float64).sum())


def conjugate_gradients(apply: Callable[[np.ndarray], np.ndarray], right: np.ndarray, steps: int) -> np.ndarray:
    """Solves ``apply``(x) = ``right`` from x = 0 in ``steps`` steps, or fewer if ‖residual‖ falls to 1 % of ‖right‖."""
    matrix = LinearOperator((right.size,) * 2, lambda x: apply(x.reshape(right.shape)).ravel(), dtype=right.dtype)
    least = 0.01 * float(np.linalg.norm(right))  # absolute, because SciPy has renamed its relative tolerance
    return cg(matrix, right.ravel(), atol=least, maxiter=steps)[0].reshape(right.shape)
