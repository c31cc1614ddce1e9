"""One interface for everything that projects: values, transposes, frames, and what SciPy asks for."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse.linalg import LinearOperator as ScipyOperator

from phyradgs_cl import checks
from phyradgs_cl.api.arrays import Values, entered, given_back, on_host
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import Runtime

Map = Callable[[Any], Any]
"""From values to values of the same place."""
Shape = tuple[int | None, ...]


class Operator:
    """A differentiable map between arrays of two shapes, on a device: ``y = A(x)``, and ``A.T(y)``.

    domain_shape, range_shape: shapes of x and y; None stands for any length. ``A.T`` is the transpose of the derivative
    at the x of the last call. Host arrays (NumPy's, or others' by DLPack) give NumPy's float32 arrays; pyopencl Arrays
    (float32, C order, on ``queue``) give such Arrays, and nothing is copied between host and device. An operator, its
    transpose and its frames share their memory on the device: use them one at a time. ``A.frames([3, 7])`` are some of
    its frames, ``A.intensity`` is the same for a detector that averages photons.

    Operators come from ``ray_operator``, ``splat_operator`` and ``voxel_operator``. One of your own has a Runtime rt, domain
    and range_ as (name, shape), at: x to (y, function from dL/dy to dL/dx), and, if it has them, what makes the operators
    of some frames and of intensity.

    Raises InputError, before anything is computed, for arrays of another shape, type or device.
    """

    _instead = "vjp has the derivative"

    def __init__(
        self,
        rt: Runtime,
        domain: tuple[str, Shape],
        range_: tuple[str, Shape],
        at: "Callable[[Values], tuple[Values, Map]]",
        *,
        frames: Callable[[list[int]], Any] | None = None,
        intensity: "Callable[[], Operator] | None" = None,
    ) -> None:
        self.rt = rt
        self._domain, self._range = domain, range_
        self._at, self._frames, self._intensity = at, frames, intensity
        self._back: Map | None = None

    @property
    def domain_shape(self) -> Shape:
        """Shape of x: (nz, ny, nx) of a volume in 1/mm, (11, None) of parameter rows of Gaussians."""
        return self._domain[1]

    @property
    def range_shape(self) -> Shape:
        """Shape of y: (F, rows, columns) of line integrals, or (nz, ny, nx) in 1/mm."""
        return self._range[1]

    @property
    def queue(self) -> Any:
        """The pyopencl.CommandQueue (in order) on which Arrays have to be."""
        return self.rt.queue

    @property
    def shape(self) -> tuple[int, int]:
        """(size of y, size of x), which SciPy asks for, of a ``LinearOperator``; of any other an InputError that says so."""
        raise self._not_linear()

    def __matmul__(self, x: Any) -> Any:
        raise self._not_linear()

    def _not_linear(self) -> InputError:
        return InputError(repr(self), "what is not linear in x", "a LinearOperator", self._instead)

    def to_device(self, values: Any) -> Any:
        """An x or a y, or a stack of them, as a pyopencl Array, float32, on ``queue``: what loops on the device begin with.

        Raises InputError for what is no array of real numbers, and one whose last axes are those of neither side.
        """
        array = on_host("values", values)
        sides = self.domain_shape, self.range_shape
        if not any(_ends_with(array.shape, side) for side in sides):
            expected = " or ".join(_text(side) for side in sides)
            raise InputError("values", f"shape {array.shape}", f"{expected}, or a stack of such")
        return given_back(self.rt, self.rt.upload(array))

    def __call__(self, x: Any) -> Any:
        """y = A(x): from ``domain_shape`` to ``range_shape``, on the device where x is."""
        y, self._back = self._value(x)
        return given_back(self.rt, y)

    def vjp(self, x: Any) -> tuple[Any, Callable[[Any], Any]]:
        """A(x), and the function from dL/dy to dL/dx at this x, whatever else is called in between."""
        y, back = self._value(x)
        return given_back(self.rt, y), lambda by_y: given_back(self.rt, back(self._entered(self._range, by_y)))

    @property
    def T(self) -> "Operator":  # noqa: N802
        """The transpose of the derivative at the last x, ``range_shape`` to ``domain_shape``; InputError before that."""
        return Operator(self.rt, self._range, self._domain, self._at_last)

    def frames(self, chosen: Sequence[int]) -> Any:
        """The operator of some of the frames, by their numbers from 0 and in this order; shares all memory.

        Raises InputError for a number that there is not, or none, or an operator without frames.
        """
        if self._frames is None:
            raise InputError("frames", repr(self), "an operator from something to frames")
        count = self._range[1][0]
        numbers = list(chosen) if isinstance(chosen, Sequence | np.ndarray) else chosen
        known = isinstance(numbers, list) and all(
            isinstance(f, int | np.integer) and not isinstance(f, bool) and 0 <= f < (count or 0) for f in numbers
        )
        if not known or not numbers:
            raise InputError("frames", checks.shown(numbers), f"at least one whole number from 0 to {(count or 0) - 1}")
        return self._frames([int(f) for f in numbers])

    @cached_property
    def intensity(self) -> "Operator":
        """The same under a detector that averages photons over an exposure: −ln Σ w exp(−p) of a line's times, not Σ w p.

        Its transpose is that of the derivative at its last x. InputError where it is not known (transposes, voxels).
        """
        if self._intensity is None:
            raise InputError("intensity", repr(self), "an operator from something to line integrals")
        return self._intensity()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({_shown(self._domain)} to {_shown(self._range)} on {self.rt.device.name})"

    def _value(self, x: Any) -> tuple[Values, Map]:
        return self._at(self._entered(self._domain, x))

    def _entered(self, side: tuple[str, Shape], values: Any) -> Values:
        return entered(self.rt, side[0], values, side[1])

    def _at_last(self, y: Values) -> tuple[Values, Map]:
        if self._back is None:
            remedy = "call the operator first: its derivative is taken at the last x"
            raise InputError("T", "no x yet", "the transpose of a derivative somewhere", remedy)
        return self._back(y), _no_derivative


class LinearOperator(Operator, ScipyOperator):
    """An ``Operator`` that is linear, and so a scipy.sparse.linalg.LinearOperator, too.

    ``A.T`` is the exact transpose, at any time. For SciPy, ``A.shape`` is (size of y, size of x), vectors are flat, float32,
    C order: ``scipy.sparse.linalg.lsqr(A, y.ravel())``, ``A @ x.ravel()``, ``A.T @ A``.

    rt, domain, range_, parts: as of ``Operator``; forward and adjoint: the two functions, from values to values. Raises
    InputError as it does.
    """

    def __init__(
        self,
        rt: Runtime,
        domain: tuple[str, Shape],
        range_: tuple[str, Shape],
        forward: Map,
        adjoint: Map,
        **parts: Any,
    ) -> None:
        Operator.__init__(self, rt, domain, range_, lambda x: (forward(x), adjoint), **parts)
        ScipyOperator.__init__(self, np.float32, (_size(range_), _size(domain)))
        self._pair = forward, adjoint

    shape = (0, 0)  # SciPy's, one for every operator
    __matmul__ = ScipyOperator.__matmul__

    @property
    def T(self) -> "LinearOperator":  # noqa: N802
        """The exact transpose: frames (F, rows, columns) to x, by the forward weights."""
        return LinearOperator(self.rt, self._range, self._domain, *self._pair[::-1])

    def _matvec(self, x: np.ndarray) -> np.ndarray:
        return self(np.reshape(x, self.domain_shape)).ravel()

    def _rmatvec(self, y: np.ndarray) -> np.ndarray:
        return self.T(np.reshape(y, self.range_shape)).ravel()

    def _transpose(self) -> "LinearOperator":
        return self.T

    _adjoint = _transpose  # of real numbers


def _no_derivative(_: Values) -> Values:
    raise InputError("T", "a transpose's derivative", "that of the operator itself")


def _shown(side: tuple[str, Shape]) -> str:
    name, shape = side
    return f"{name} {_text(shape)}"


def _text(shape: Shape) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"


def _ends_with(shape: tuple[int, ...], side: Shape) -> bool:
    last = shape[len(shape) - len(side) :]
    return len(shape) >= len(side) and all(n in (None, found) for n, found in zip(side, last, strict=True))


def _size(side: tuple[str, Shape]) -> int:
    return int(np.prod([n or 1 for n in side[1]], dtype=np.int64))
