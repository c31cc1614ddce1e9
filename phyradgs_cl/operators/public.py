"""Operators as user programs see them: y = A(x) for arrays on host or device, A's transpose or derivative, A for some of the
frames only, and A as an operator of SciPy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse.linalg import LinearOperator as ScipyOperator

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import DeviceArray, Runtime, adopted, is_cl_array, lent

Values = np.ndarray | DeviceArray
"""float32 values in C order, on the host or the device."""
Map = Callable[[Any], Any]
"""A function from ``Values`` to ``Values``. Its result is on the device if its argument is, else on the host."""
Shape = tuple[int | None, ...]


def to_user_array(rt: Runtime, values: Values) -> Any:
    """Returns a result as users get it: pyopencl's Array if it is on the device, else a NumPy array."""
    return lent(values, rt.queue) if isinstance(values, DeviceArray) else values


def moved_to(rt: Runtime, values: Values, on_device: bool) -> Any:
    """Returns values on the device (``on_device``) or on the host. Copies them only if they are not there yet."""
    if isinstance(values, DeviceArray):
        return values if on_device else rt.download(values)
    return rt.upload(values) if on_device else values


def computed(rt: Runtime, on_device: bool, function: Callable[[Any], Values], values: Values) -> Any:
    """Applies a function that needs its argument on the device if ``on_device``, else on the host. Returns the function's
    result on the device if ``values`` are there, else on the host."""
    return moved_to(rt, function(moved_to(rt, values, on_device)), isinstance(values, DeviceArray))


def on_host(name: str, values: Any) -> np.ndarray:
    """Returns an array on the host as NumPy's float32 in C order. Arrays of other libraries are read by DLPack, without a
    copy. Raises InputError about ``name`` for masked arrays and for anything else."""
    checks.unmasked(name, values)
    has_dlpack = hasattr(values, "__dlpack__") and not isinstance(values, np.ndarray)
    try:
        array = np.from_dlpack(values) if has_dlpack else np.asarray(values)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"numbers of type {array.dtype}")
        return np.ascontiguousarray(array, np.float32)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        raise checks.not_on_host(name, values, error) from error


class Operator:
    """A differentiable map between arrays, computed on a device: ``y = A(x)``, and ``A.derivative(x).T(y)``.

    domain_shape, range_shape: shapes of x and y; None stands for any length. ``A.frames([3, 7])`` is the operator to only
    these frames. ``A.intensity`` is the operator of a detector that averages photons.

    Host arrays (NumPy's, or others by DLPack) give NumPy float32 arrays. pyopencl Arrays (float32, C order, on ``queue``)
    give such Arrays, and nothing is copied between host and device. An operator, its transpose and its ``frames`` share
    memory on the device: use one at a time.

    Operators come from ``ray_operator``, ``splat_operator`` and ``voxel_operator``. To write another one, give: its Runtime
    rt; domain and range_, each (name, shape); ``at``, a function that returns y and the function from dL/dy to dL/dx (vjp)
    for an x. frames, intensity: functions that make the operators of these names, if any.

    Raises InputError, before anything is computed, for arrays of another shape, type or device."""

    _instead = "derivative(x).T is the transpose at x, and vjp(x) also has the value"

    def __init__(
        self, rt: Runtime, domain: tuple[str, Shape], range_: tuple[str, Shape],
        at: "Callable[[Values], tuple[Values, Map]]", *, frames: Callable[[list[int]], Any] | None = None,
        intensity: "Callable[[], Operator] | None" = None,
    ) -> None:
        self.rt = rt
        self._domain, self._range = domain, range_
        self._at, self._frames, self._intensity = at, frames, intensity

    @property
    def domain_shape(self) -> Shape:
        """Shape of x: (nz, ny, nx) of a volume in 1/mm, or (11, None) of the parameters of Gaussians."""
        return self._domain[1]

    @property
    def range_shape(self) -> Shape:
        """Shape of y: (F, rows, columns) of line integrals, or (nz, ny, nx) in 1/mm."""
        return self._range[1]

    @property
    def queue(self) -> Any:
        """The in-order pyopencl.CommandQueue on which Arrays for the operator must be."""
        return self.rt.queue

    @property
    def shape(self) -> tuple[int, int]:
        """(size of y, size of x), which SciPy needs of a ``LinearOperator``. Raises InputError for other operators."""
        raise self._not_linear()

    def __matmul__(self, x: Any) -> Any:
        raise self._not_linear()

    def _not_linear(self) -> InputError:
        return InputError(repr(self), "an operator that is not linear in x", "a LinearOperator", self._instead)

    def to_device(self, values: Any) -> Any:
        """Copies an x or a y, or a stack of them, to a pyopencl Array (float32) on ``queue``, for a loop on the device.

        Raises InputError unless ``values`` is an array of real numbers whose last axes have the shape of x or of y."""
        array = on_host("values", values)
        sides = self.domain_shape, self.range_shape
        if not any(_ends_with(array.shape, side) for side in sides):
            expected = " or ".join(_text(side) for side in sides)
            raise InputError("values", f"shape {array.shape}", f"{expected}, or a stack of such")
        return to_user_array(self.rt, self.rt.upload(array))

    def __call__(self, x: Any) -> Any:
        """Returns y = A(x), from ``domain_shape`` to ``range_shape``, on the device if x is there, else on the host."""
        return to_user_array(self.rt, self._value(x)[0])

    def vjp(self, x: Any) -> tuple[Any, Callable[[Any], Any]]:
        """Returns A(x), and the function from dL/dy to dL/dx at this x. Later calls do not affect that function."""
        y, back = self._value(x)

        def by_x(by_y: Any) -> Any:
            return to_user_array(self.rt, back(self._to_array(self._range, by_y)))

        return to_user_array(self.rt, y), by_x

    def derivative(self, x: Any) -> Any:
        """Computes A(x) and returns the derivative at x, whose ``T`` maps dL/dy (range_shape) to dL/dx (domain_shape)."""
        return Derivative(self.vjp(x)[1])

    @property
    def T(self) -> "LinearOperator":  # noqa: N802
        """The exact transpose of a ``LinearOperator``. Raises InputError for other operators."""
        raise self._not_linear()

    def frames(self, chosen: Sequence[int]) -> Any:
        """Returns the operator to some of the frames, given by their numbers from 0, in this order. Both share all memory.

        Raises InputError for numbers of missing frames, for no number, and for an operator without frames."""
        if self._frames is None:
            raise InputError("frames", repr(self), "an operator from something to frames")
        count = self._range[1][0] or 0
        numbers = list(chosen) if isinstance(chosen, Sequence | np.ndarray) else []
        if not numbers or not all(_is_index(number, count) for number in numbers):
            raise InputError("frames", checks.short_repr(chosen), f"at least one whole number from 0 to {count - 1}")
        return self._frames([int(f) for f in numbers])

    @cached_property
    def intensity(self) -> "Operator":
        """The operator of a detector that averages photons: −ln Σ w exp(−p), with weights w, over the times of an exposure.

        The plain operator averages line integrals, Σ w p. Raises InputError for transposes and operators to voxels."""
        if self._intensity is None:
            raise InputError("intensity", repr(self), "an operator from something to line integrals")
        return self._intensity()

    def __repr__(self) -> str:
        domain, range_ = (f"{name} {_text(shape)}" for name, shape in (self._domain, self._range))
        return f"{type(self).__name__}({domain} to {range_} on {self.rt.device.name})"

    def _value(self, x: Any) -> tuple[Values, Map]:
        return self._at(self._to_array(self._domain, x))

    def _to_array(self, side: tuple[str, Shape], values: Any) -> Values:
        """Returns an x or a y as float32 in C order, left on the host or device. Copies only other types or layouts."""
        array = adopted(side[0], values, self.queue) if is_cl_array(values) else on_host(side[0], values)
        checks.shape(side[0], array, side[1])  # type: ignore[arg-type]
        return array


@dataclass(frozen=True)
class Derivative:
    """The derivative of an operator at one x. T: the function from dL/dy to dL/dx, which stays valid after later calls."""

    T: Map


class LinearOperator(Operator, ScipyOperator):  # type: ignore[misc]  # SciPy has no types
    """An ``Operator`` that is linear, so that it is a scipy.sparse.linalg.LinearOperator too.

    ``A.T`` is the exact transpose. For SciPy, ``A.shape`` is (size of y, size of x), and vectors are flat, float32, in C
    order: ``scipy.sparse.linalg.lsqr(A, y.ravel())``, ``A @ x.ravel()``, ``A.T @ A``.

    rt, domain, range_, and frames and intensity in ``parts``: as for ``Operator``. forward, adjoint: the functions from x
    to y and from y to x. Raises InputError as ``Operator`` does."""

    def __init__(
        self, rt: Runtime, domain: tuple[str, Shape], range_: tuple[str, Shape], forward: Map, adjoint: Map,
        **parts: Any,
    ) -> None:
        Operator.__init__(self, rt, domain, range_, lambda x: (forward(x), adjoint), **parts)
        ScipyOperator.__init__(self, np.float32, (_size(range_), _size(domain)))
        self._pair = forward, adjoint

    shape = (0, 0)  # this attribute of SciPy replaces the property; each instance sets its own
    __matmul__ = ScipyOperator.__matmul__

    @property
    def T(self) -> "LinearOperator":  # noqa: N802
        """The exact transpose, with the same weights: maps arrays of the shape of y to arrays of the shape of x."""
        return LinearOperator(self.rt, self._range, self._domain, *self._pair[::-1])

    def derivative(self, x: Any) -> "LinearOperator":
        """Returns the operator itself, because it is linear."""
        return self

    def dot(self, x: Any) -> Any:
        """Returns the product A x, as ``@`` does. Raises InputError for masked arrays, whose mask SciPy would drop."""
        checks.unmasked(self._domain[0], x)
        return ScipyOperator.dot(self, x)

    def _matvec(self, x: np.ndarray) -> Any:
        return self(np.reshape(x, self.domain_shape)).ravel()

    def _rmatvec(self, y: np.ndarray) -> Any:
        return self.T(np.reshape(y, self.range_shape)).ravel()

    def _transpose(self) -> "LinearOperator":
        return self.T

    _adjoint = _transpose  # an operator on real numbers has its transpose as its adjoint


def _is_index(number: object, count: int) -> bool:
    is_whole = isinstance(number, int | np.integer) and not isinstance(number, bool)
    return is_whole and 0 <= number < count  # type: ignore[operator]


def _text(shape: Shape) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"


def _ends_with(shape: tuple[int, ...], side: Shape) -> bool:
    last = shape[len(shape) - len(side) :]
    return len(shape) >= len(side) and all(n in (None, size) for n, size in zip(side, last, strict=True))


def _size(side: tuple[str, Shape]) -> int:
    return int(np.prod([n or 1 for n in side[1]], dtype=np.int64))
