"""Sums, products and norms of arrays behind one interface (``Space``): NumPy on the host, cl/algebra.cl on a device.

An iterative method is written once, in terms of a ``Space``. A ``Space`` returns arrays, which stay on the device, or
numbers on the host. The same arrays on the same device always give the same bits."""

import weakref
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.runtime.context import Runtime
from phyradgs_cl.runtime.memory import DeviceArray

A = TypeVar("A")
Shape = tuple[int, ...]
_CPU_SPAN = 1 << 14  # least number of array elements that a CPU's work-item sums: starting a work-item then costs little
_GPU_GROUP = 256  # largest work-group on a GPU, in work-items
_GPU_GROUPS = 512  # most parts into which a sum is divided: work-groups on a GPU, work-items on a CPU
_ITEMS = 64  # size of a work-group of element-wise kernels on a CPU, in work-items


class Space(Protocol, Generic[A]):
    """Arrays on the host or on a device, and their algebra. Operands have the same shape unless a method says otherwise."""

    def array(self, values: np.ndarray) -> A:
        """Returns NumPy values as an array of this space. The two may share memory."""

    def numpy(self, x: A) -> np.ndarray:
        """Returns the values of ``x`` as a NumPy array, which may share memory with ``x``."""

    def full(self, shape: Shape, value: float) -> A: ...

    def place(self, shape: Shape) -> A | None:
        """Returns uninitialised device memory, to pass to an operator as ``out``, where it writes its result. Returns None
        on the host, where operators allocate their results."""

    def take(self, x: A, chosen: Sequence[int]) -> A:
        """Returns the entries of ``x`` with the indices ``chosen`` along its first axis, in the order of ``chosen``."""

    def add(self, x: A, y: A, scale: float = 1.0, *, nonnegative: bool = False) -> A:
        """Returns x + ``scale`` y, clipped at 0 if ``nonnegative``."""

    def extrapolate(self, x: A, y: A, scale: float) -> A:
        """Returns x + ``scale`` (x − y)."""

    def add_product(self, x: A, y: A, z: A, scale: float = 1.0, *, nonnegative: bool = False) -> A:
        """Returns x + ``scale`` y z element by element, clipped at 0 if ``nonnegative``."""

    def multiply(self, x: A, y: A) -> A:
        """Returns x y element by element. y may lack the first axes of x: it is then repeated along these axes."""

    def reciprocal(self, x: A, share: float) -> A:
        """Returns 1/max(x, ``share`` · m) where x > 0, else 0. m: the largest x. The bound limits the results of small x."""

    def inner(self, x: A, y: A) -> float:
        """Returns Σ x y, with the accuracy of float64."""

    def turn(self, x: A, y: A, z: A) -> float:
        """Returns Σ (x − y)(y − z), the inner product of the steps from z to y and from y to x."""

    def norm(self, x: A) -> float:
        """Returns √Σ x²."""

    def sum_squares(self, arrays: Iterable[A]) -> float:
        """Returns Σ ‖x‖² over ``arrays``, which may be a generator. A device sends back only the sum over all arrays."""

    def largest(self, x: A, *, absolute: bool = False) -> float:
        """Returns the largest element of x, or of |x| if ``absolute``."""


class HostSpace:
    """The ``Space`` of NumPy arrays of any float type. Tests compare ``DeviceSpace`` with it."""

    def array(self, values: np.ndarray) -> np.ndarray:
        return values

    def numpy(self, x: np.ndarray) -> np.ndarray:
        return x

    def full(self, shape: Shape, value: float) -> np.ndarray:
        return np.full(shape, value, np.float32)

    def place(self, shape: Shape) -> None:
        return None

    def take(self, x: np.ndarray, chosen: Sequence[int]) -> np.ndarray:
        return x[list(chosen)]

    def add(
        self, x: np.ndarray, y: np.ndarray, scale: float = 1.0, *, nonnegative: bool = False
    ) -> np.ndarray:
        result: np.ndarray = x + np.float32(scale) * y
        return np.maximum(result, 0, out=result) if nonnegative else result

    def extrapolate(self, x: np.ndarray, y: np.ndarray, scale: float) -> np.ndarray:
        return x + np.float32(scale) * (x - y)

    def add_product(
        self, x: np.ndarray, y: np.ndarray, z: np.ndarray, scale: float = 1.0, *, nonnegative: bool = False
    ) -> np.ndarray:
        result: np.ndarray = x + np.float32(scale) * y * z
        return np.maximum(result, 0, out=result) if nonnegative else result

    def multiply(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return x * y

    def reciprocal(self, x: np.ndarray, share: float) -> np.ndarray:
        # Without any x above 0 every result is 0; 1.0 merely avoids a division by 0.
        least = share * max(self.largest(x), 0.0) or 1.0
        return np.where(x > 0, 1 / np.maximum(x, least), 0).astype(np.float32)

    def inner(self, x: np.ndarray, y: np.ndarray) -> float:
        return inner(x, y)

    def turn(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> float:
        return inner(x - y, y - z)

    def norm(self, x: np.ndarray) -> float:
        return norm(x)

    def sum_squares(self, arrays: Iterable[np.ndarray]) -> float:
        return sum(inner(x, x) for x in arrays)

    def largest(self, x: np.ndarray, *, absolute: bool = False) -> float:
        return float((np.abs(x) if absolute else x).max(initial=-np.inf))


class DeviceSpace:
    """The ``Space`` of float32 arrays on one device. New arrays reuse the memory of released ones."""

    def __init__(self, rt: Runtime) -> None:
        self.rt = rt
        self._unused: dict[int, list[DeviceArray]] = defaultdict(list)
        # Memory for the work-groups' partial sums, for the sum of one array, and for a sum over several arrays.
        self._parts, self._whole, self._total = (rt.empty(count, np.float64) for count in (_GPU_GROUPS, 1, 1))

    def empty(self, shape: Shape) -> DeviceArray:
        """Returns uninitialised memory, that of a released array of this size if there is one. Queued work may still read
        that array: the queue is in order, so writes to the new array come later."""
        unused = self._unused[int(np.prod(shape, dtype=np.int64))]
        memory = unused.pop() if unused else self.rt.empty(shape)
        array = DeviceArray(memory.buffer, tuple(shape), memory.dtype)
        weakref.finalize(array, unused.append, memory)
        return array

    def array(self, values: np.ndarray) -> DeviceArray:
        array = self.empty(values.shape)
        self.rt.write(array, values)
        return array

    def numpy(self, x: DeviceArray) -> np.ndarray:
        return self.rt.download(x)

    def full(self, shape: Shape, value: float) -> DeviceArray:
        array = self.empty(shape)
        self.rt.fill(array, value)
        return array

    def place(self, shape: Shape) -> DeviceArray:
        return self.empty(shape)

    def take(self, x: DeviceArray, chosen: Sequence[int]) -> DeviceArray:
        result = self.empty((len(chosen), *x.shape[1:]))
        each = result.nbytes // len(chosen)
        for k, entry in enumerate(chosen):
            self.rt.copy(x, result, nbytes=each, source_offset=entry * each, target_offset=k * each)
        return result

    def add(
        self, x: DeviceArray, y: DeviceArray, scale: float = 1.0, *, nonnegative: bool = False
    ) -> DeviceArray:
        return self._each("add_scaled", x, np.float32(scale), y, _least(nonnegative))

    def extrapolate(self, x: DeviceArray, y: DeviceArray, scale: float) -> DeviceArray:
        return self._each("extrapolate", x, np.float32(scale), y)

    def add_product(
        self, x: DeviceArray, y: DeviceArray, z: DeviceArray, scale: float = 1.0, *, nonnegative: bool = False
    ) -> DeviceArray:
        return self._each("add_product", x, np.float32(scale), y, z, _least(nonnegative))

    def multiply(self, x: DeviceArray, y: DeviceArray) -> DeviceArray:
        return self._each("multiply", x, y, period=y.size)

    def reciprocal(self, x: DeviceArray, share: float) -> DeviceArray:
        return self._each("reciprocal", x, np.float32(share * max(self.largest(x), 0.0) or 1.0))

    def descend(self, x: DeviceArray, y: DeviceArray, step: float) -> DeviceArray:
        """Returns x − ``step`` y/‖y‖, or x if y is all 0. The host need not wait, since ‖y‖ stays on the device."""
        self._sum("dot_parts", self._whole, y, y)
        # Two float32, the rounded step and its rounding error, keep the step's precision on devices without float64.
        high = np.float32(step)
        return self._each("descend", x, y, np.array([high, step - float(high)], np.float32), self._whole)

    def inner(self, x: DeviceArray, y: DeviceArray) -> float:
        self._sum("dot_parts", self._whole, x, y)
        return self._read(self._whole)

    def turn(self, x: DeviceArray, y: DeviceArray, z: DeviceArray) -> float:
        self._sum("turn_parts", self._whole, x, y, z)
        return self._read(self._whole)

    def norm(self, x: DeviceArray) -> float:
        return self.inner(x, x) ** 0.5

    def sum_squares(self, arrays: Iterable[DeviceArray]) -> float:
        count = 0
        for count, x in enumerate(arrays, start=1):
            self._sum("dot_parts", self._total, x, x, add=count > 1)
        return self._read(self._total) if count else 0.0

    def largest(self, x: DeviceArray, *, absolute: bool = False) -> float:
        groups = self._reduce("largest_parts", x, absolute, scratch=4)
        return float(self.rt.download(self._parts).view(np.float32)[:groups].max())

    def _each(self, name: str, x: DeviceArray, *others: Any, period: int = 0) -> DeviceArray:
        """Returns the result of the element-wise kernel ``name`` for x and ``others``. period: the size of an operand that
        is smaller than x and repeats along x; 0 if all operands have the size of x."""
        result, count = self.empty(x.shape), period or x.size
        items = ceil_div(count, self.rt.lanes), x.size // max(count, 1)
        kernel = self.rt.kernel("algebra", name)
        self.rt.launch(
            kernel, items, x, *others, np.int64(count), result, group=self.rt.group(_ITEMS, _GPU_GROUP)
        )
        return result

    def _read(self, number: DeviceArray) -> float:
        values = self.rt.download(number)
        return float(values[0] if self.rt.fp64 else values.view(np.float32).astype(np.float64).sum())

    def _sum(self, name: str, whole: DeviceArray, *arrays: DeviceArray, add: bool = False) -> None:
        """Writes the sum that kernel ``name`` computes from ``arrays`` to ``whole``, or adds it there if ``add``. The kernel
        sums within each work-group, and a second kernel sums over the work-groups."""
        groups = self._reduce(name, *arrays, scratch=8)
        kernel = self.rt.kernel("algebra", "dot_whole")
        group = self.rt.group(1, _GPU_GROUP, kernel)
        self.rt.launch(kernel, group, self._parts, groups, add, self.rt.local(8 * group), whole, group=group)

    def _reduce(self, name: str, *arguments: Any, scratch: int) -> int:
        """Launches kernel ``name``, whose work-groups each write a partial result to ``_parts``. Returns the number of these
        results. scratch: bytes of local memory per work-item."""
        kernel = self.rt.kernel("algebra", name)
        count, group = arguments[0].size, self.rt.group(1, _GPU_GROUP, kernel)
        if self.rt.pixel_items:  # on a GPU, neighbouring work-items read neighbouring elements
            groups = min(_GPU_GROUPS, ceil_div(count, group))
            first_by, step, span = 1, groups * group, count
        else:
            span = max(_CPU_SPAN, ceil_div(count, _GPU_GROUPS))
            span = ceil_div(span, self.rt.lanes) * self.rt.lanes
            groups, first_by, step = ceil_div(count, span), span, self.rt.lanes
        where = (np.int64(n) for n in (count, first_by, step, span))
        local = self.rt.local(scratch * group)
        self.rt.launch(kernel, groups * group, *arguments, *where, local, self._parts, group=group)
        return groups


def norm(values: np.ndarray) -> float:
    """Returns the Euclidean norm of a NumPy array of any shape, summed in float64."""
    return inner(values, values) ** 0.5


def inner(a: np.ndarray, b: np.ndarray) -> float:
    """Returns the inner product of two NumPy arrays of the same shape, summed in float64.

    BLAS is avoided: its threads wait for cores that a CPU device keeps busy, which took most of the time of small runs."""
    return float(np.einsum("i,i->", a.ravel(), b.ravel(), dtype=np.float64))


def _least(nonnegative: bool) -> float:
    return 0.0 if nonnegative else -np.inf
