"""``Runtime``: one OpenCL device with its in-order command queue, the programs built for it, and its buffers."""

import logging
import math
import threading
import time
import warnings
import weakref
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.errors import DeviceError
from phyradgs_cl.parallel import Communicator
from phyradgs_cl.runtime.device import DeviceInfo, choose_device, warn_of_fault
from phyradgs_cl.runtime.memory import DeviceArray, LaterItem, MemoryLedger, Room, Traffic, memory_limit
from phyradgs_cl.runtime.opencl import Kernel, cl, kernel_source, naming_failures, placed_errors
from phyradgs_cl.runtime.profile import KernelUse, Profile, Rates, measure_rates

log = logging.getLogger(__name__)
Sides = tuple[int, ...]

LANE_CHOICES = (1, 4, 8, 16)  # numbers of floats that a kernel's vectors may have
# The compiler's option that fuses multiply and add; the line by which a source begins its header for pairs of float32.
_FUSING, _PAIRS = "-cl-mad-enable", '#line 1 "common/precise.h"'
_TILE_ITEMS = 256  # largest work-group that shares a tile of pixels, in work-items
_FEWEST_ITEMS = 32  # a kernel whose launch asks for groups of this many work-items or more must allow at least this many


class Runtime:
    """One OpenCL device and all that runs on it: declare a ``kernel``, make arrays (``empty``, ``upload``), then ``launch``.

    - device: as ``wish`` of ``choose_device``.
    - lanes: the number of floats in a kernel's vectors; None takes the device's width. It is 1 on GPUs, where neighbouring
      work-items do the work of a CPU's vector.
    - fp64: False makes kernels use pairs of float32 in place of float64, as on devices without float64.
    - pixel_items: True gives each work-item one pixel (needs ``lanes`` 1), False one line of pixels or more (for CPUs). None
      takes False on a CPU, else True.
    - memory: the largest sum of the sizes of all buffers, in bytes or as text like 2GiB. profile: True times every kernel.
    - ranks: the MPI processes that work on the same scan, each with its own Runtime. On a machine with several equal
      devices, each rank takes another one.

    Raises DeviceError for a device that does not exist or cannot be opened, and for ``lanes`` other than 1, 4, 8 or 16, or
    other than 1 with ``pixel_items``. Raises InputError for a ``memory`` that is no size."""

    # Most samples of rays in one GPU launch, 0.1 s on a slow GPU: display drivers kill launches that take seconds.
    most_samples = 2**29

    def __init__(
        self, device: str | None = None, *, lanes: int | None = None, fp64: bool | None = None,
        pixel_items: bool | None = None, profile: bool = False, memory: str | int | None = None,
        ranks: Communicator | None = None,
    ) -> None:
        limit_bytes = memory_limit(memory)
        self.ranks = Communicator() if ranks is None else ranks
        self.device: DeviceInfo
        self.device, self.reason = choose_device(device, self.ranks.local_rank, "device")
        warn_of_fault(self.device)
        self.ledger = MemoryLedger(self.device, limit_bytes)
        self.traffic = Traffic()
        properties = cl.command_queue_properties.PROFILING_ENABLE if profile else 0
        try:
            self.context = cl.Context([self.device.handle])
            self.queue = cl.CommandQueue(self.context, properties=properties)  # type: ignore[arg-type]
        except cl.Error as error:
            raise self.ledger.error("opening it", error) from error
        self.lanes = lanes or default_lanes(self.device)
        if self.lanes not in LANE_CHOICES:
            raise DeviceError("lanes", str(self.lanes), f"one of {LANE_CHOICES}")
        self.fp64 = self.device.has_fp64 if fp64 is None else (fp64 and self.device.has_fp64)
        self.pixel_items = self.device.kind != "cpu" if pixel_items is None else pixel_items
        if self.pixel_items and self.lanes != 1:
            raise DeviceError("lanes", str(self.lanes), "1 where work-items are pixels")
        # Without this flag a CPU's driver may allocate at a buffer's first use, and end the process if memory is short then.
        at_once = cl.mem_flags.ALLOC_HOST_PTR if self.device.kind == "cpu" else 0
        self._memory_flags = cl.mem_flags.READ_WRITE | at_once
        self.profile = profile
        self._multiple: int | None = None
        self._profile = Profile()
        self._programs: dict[tuple[str, tuple[str, ...]], cl.Program] = {}
        self._kernels: dict[tuple[str, str, tuple[str, ...]], Kernel] = {}
        self._launching = threading.Lock()  # a kernel keeps one set of arguments, and Python threads may launch the same one

    def kernel(self, program: str, name: str, **defines: int | float | bool) -> Kernel:
        """Declares the kernel ``name`` of ``cl/<program>.cl`` with macros ``defines``. Nothing is built before its first
        launch. Equal declarations return the same kernel."""
        merged: dict[str, int | float | bool] = {"LANES": self.lanes, "FP64": int(self.fp64), **defines}
        flags = [f"-D{name}={_literal(value)}" for name, value in sorted(merged.items())]
        key = (program, name, ("-cl-std=CL1.2", "-w", _FUSING, *flags))
        return self._kernels.setdefault(key, Kernel(*key))

    def compile(self, kernel: Kernel) -> "cl.Kernel":
        """Returns pyopencl's built kernel. The first call for a program and its options builds all of its kernels."""
        if kernel.built is None:
            key = (kernel.program, kernel.options)
            if key not in self._programs:
                self._programs[key] = self._build(*key)
            kernel.built = cl.Kernel(self._programs[key], kernel.function_name)
        return kernel.built

    @property
    def built_kernels(self) -> set[str]:
        """The names of the kernels that have been built, which happens at their first launch."""
        return {kernel.function_name for kernel in self._kernels.values() if kernel.built is not None}

    @property
    def group_limits(self) -> dict[str, int]:
        """The largest work-group that the driver allows, in work-items, by kernel name. Lists only kernels for which the
        driver has been asked."""
        return {one.function_name: one.most_items for one in self._kernels.values() if one.most_items is not None}

    def _build(self, program: str, options: tuple[str, ...]) -> "cl.Program":
        started = time.perf_counter()
        try:
            source = kernel_source(program)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", cl.CompilerWarning)
                built = cl.Program(self.context, source).build(options=self._allowed(source, options))
        except cl.Error as error:
            message = " ".join((placed_errors(str(error), source) or str(error).splitlines())[:3])[:600]
            subject, remedy = f"kernel {program}.cl on {self.device.name}", "try another --device"
            raise DeviceError(subject, message, "a program that builds", remedy) from error
        log.debug("built %s in %.2f s", program, time.perf_counter() - started)
        return built

    @staticmethod
    def _allowed(source: str, options: tuple[str, ...]) -> list[str]:
        """Returns ``options``, without fusing of multiply and add if the source uses pairs of float32 in place of float64.
        Fusing would destroy the pairs' low parts, and some drivers ignore the pragma against it."""
        has_pairs = "-DFP64=0" in options and _PAIRS in source
        return [option for option in options if not (has_pairs and option == _FUSING)]

    def empty(self, shape: int | Sequence[int], dtype: np.typing.DTypeLike = np.float32) -> DeviceArray:
        """Returns an array with undefined values. Raises MemoryShortage if it does not fit into the device's memory or under
        the limit, and DeviceError for other failures."""
        shape = (int(shape),) if isinstance(shape, (int, np.integer)) else tuple(int(n) for n in shape)
        kind = np.dtype(dtype)
        nbytes = max(int(np.prod(shape, dtype=np.int64)), 1) * kind.itemsize
        self.ledger.check(nbytes, self.device.largest_allocation_bytes)
        try:
            buffer = cl.Buffer(self.context, self._memory_flags, nbytes)
        except cl.Error as error:
            raise self.ledger.error(f"{nbytes / 2**20:.0f} MiB", error, self.queue) from error
        array = DeviceArray(buffer, shape, kind)
        self.ledger.count(nbytes)
        weakref.finalize(array, self.ledger.count, -nbytes)
        return array

    def room(self) -> Room:
        """Returns how many bytes of device memory an operator may use now: in all buffers together, and in one."""
        return self.ledger.room(self.device.largest_allocation_bytes)

    @property
    def peak_bytes(self) -> int:
        """The most device memory in use at one time, in bytes, since the start or the last ``reset_peak``."""
        return self.ledger.peak_bytes

    def reset_peak(self) -> None:
        self.ledger.peak_bytes = self.ledger.held_bytes

    def zeros(self, shape: int | Sequence[int], dtype: np.typing.DTypeLike = np.float32) -> DeviceArray:
        array = self.empty(shape, dtype)
        self.fill(array, 0)
        return array

    @naming_failures("a fill")
    def fill(self, array: DeviceArray, value: float) -> None:
        pattern, nbytes = np.array(value, dtype=array.dtype), max(array.nbytes, array.dtype.itemsize)
        event = cl.enqueue_fill_buffer(self.queue, array.buffer, pattern, 0, nbytes)
        self._record("fill", event, array.nbytes)

    def upload(self, values: np.ndarray, dtype: np.typing.DTypeLike | None = None) -> DeviceArray:
        values = np.ascontiguousarray(values, dtype=dtype)
        array = self.empty(values.shape, values.dtype)
        self.write(array, values)
        return array

    @naming_failures("a copy to it")
    def write(self, array: DeviceArray, values: np.ndarray) -> None:
        """Copies NumPy values (same size) into an existing array, and returns once the values may be overwritten."""
        values = np.ascontiguousarray(values, dtype=array.dtype)
        if values.size:
            cl.enqueue_copy(self.queue, array.buffer, values, is_blocking=True)
            self.traffic.count(up=values.nbytes)

    @naming_failures("a copy from it")
    def download(self, array: DeviceArray) -> np.ndarray:
        values = np.empty(array.shape, array.dtype)
        if values.size:
            cl.enqueue_copy(self.queue, values, array.buffer, is_blocking=True)
            self.traffic.count(down=values.nbytes)
        return values

    @naming_failures("a copy from it")
    def read_item(self, array: DeviceArray, index: int) -> np.generic:
        """Waits for all work enqueued before, and returns element ``index`` of the flattened array."""
        value = np.empty(1, array.dtype)
        offset = index * array.dtype.itemsize
        cl.enqueue_copy(self.queue, value, array.buffer, src_offset=offset, is_blocking=True)
        self.traffic.count(down=value.nbytes)
        return value[0]

    @naming_failures("a copy from it")
    def read_item_later(self, array: DeviceArray, index: int) -> LaterItem:
        """Asks for element ``index`` of the flattened array, as it will be after all work enqueued so far. Does not wait."""
        value = np.empty(1, array.dtype)
        offset = index * array.dtype.itemsize
        event = cl.enqueue_copy(self.queue, value, array.buffer, src_offset=offset, is_blocking=False)
        self.queue.flush()
        self.traffic.bytes_down += value.nbytes
        return LaterItem(value, event)

    @naming_failures("a copy")
    def copy(
        self, source: DeviceArray, target: DeviceArray, *, nbytes: int | None = None, source_offset: int = 0,
        target_offset: int = 0,
    ) -> None:
        """Copies one device array to another: all of the source, or ``nbytes``. Offsets are in bytes."""
        count = source.nbytes if nbytes is None else nbytes
        to, of = target.buffer, source.buffer
        event = cl.enqueue_copy(
            self.queue, to, of, byte_count=count, src_offset=source_offset, dst_offset=target_offset
        )
        self._record("copy", event, 2 * count)

    @staticmethod
    def local(nbytes: int) -> "cl.LocalMemory":
        return cl.LocalMemory(nbytes)

    def launch(
        self, kernel: Kernel, items: int | tuple[int, ...], *args: Any, group: int | tuple[int, ...] = 1, samples: int = 0
    ) -> None:
        """Enqueues ``items`` work-items, rounded up to whole work-groups. Kernels must ignore items past the last.

        group: the sides of a work-group in work-items; missing sides are 1. An int is the side along the first axis; if this
        axis is short, a GPU's group extends along other axes. Sides are halved until the kernel can run.
        samples: how long the launch takes, as the number of samples of rays that could be read in that time. On a GPU, a
        launch of more than ``most_samples`` is divided into several. Items keep their global ids, groups get new ids.
        args: a Python int becomes a C int, a Python float a C float. Give np.int64 for a long.
        Raises DeviceError, or MemoryShortage, where a launch fails."""
        shape = (items,) if isinstance(items, (int, np.integer)) else items
        if min(shape) < 1:
            return
        given = (*group, *([1] * (len(shape) - len(group)))) if isinstance(group, tuple) else self._sides(group, shape)
        local = self._fitting(kernel, given)
        rounded = tuple(ceil_div(int(n), size) * size for n, size in zip(shape, local, strict=True))
        arrays = [a for a in args if isinstance(a, DeviceArray)]
        nbytes = sum(a.nbytes for a in arrays) if self.profile else 0
        pieces = ceil_div(samples, self.most_samples) if self.pixel_items else 1
        try:  # the decorator ``naming_failures`` would add a call to each of an iteration's thousands of launches
            built = self.compile(kernel)
            with self._launching:
                built.set_args(*map(_argument, args))
                for first, part in _parts(rounded, local, pieces):
                    event = cl.enqueue_nd_range_kernel(self.queue, built, part, local, first)
                    self._record(kernel.function_name, event, nbytes if first is None or not any(first) else 0)
                    if first is not None:
                        self.queue.flush()  # without a flush the driver may give the GPU several parts of a launch at once
        except cl.Error as error:
            raise self.ledger.error(f"a launch of {kernel.function_name}", error, self.queue) from error

    def _sides(self, items: int, shape: Sides) -> Sides:
        """Returns the sides of a work-group of ``items`` work-items for a launch of ``shape``: (items, 1, ...). On a GPU,
        work-items past the end of a short first axis would idle. There, factors of 2 move from the group's first side to
        an axis whose length they divide."""
        sides = [int(items), *([1] * (len(shape) - 1))]
        while self.pixel_items and sides[0] % 2 == 0 and sides[0] // 2 >= shape[0]:
            axis = next((k for k in range(1, len(shape)) if shape[k] % (2 * sides[k]) == 0), None)
            if axis is None:
                break
            sides[0], sides[axis] = sides[0] // 2, 2 * sides[axis]
        return tuple(sides)

    def group(self, on_cpu: int = 1, on_gpu: int = 64, *kernels: Kernel) -> int:
        """Returns a work-group's size in work-items: ``on_cpu``, or ``on_gpu`` halved until all ``kernels`` can run. Name
        here all kernels whose local memory depends on the size: ``launch`` may halve their groups, but not their memory."""
        while self.pixel_items and any(on_gpu > self.most_items(kernel) for kernel in kernels):
            on_gpu //= 2
        return on_gpu if self.pixel_items else on_cpu

    def most_items(self, kernel: Kernel) -> int:
        """Returns the largest work-group in which a kernel can run, in work-items. A kernel that uses many registers may
        allow fewer than the device."""
        if kernel.most_items is None:
            kernel.most_items = self._asked(kernel, "WORK_GROUP_SIZE")
        return kernel.most_items

    def _asked(self, kernel: Kernel, name: str) -> int:
        return int(self.compile(kernel).get_work_group_info(getattr(cl.kernel_work_group_info, name), self.device.handle))

    def _fitting(self, kernel: Kernel, group: tuple[int, ...]) -> tuple[int, ...]:
        """Returns a work-group's sides, halved until the kernel can run. Raises DeviceError for a group of several
        work-items if the kernel allows neither the whole group nor 32 work-items."""
        if math.prod(group) == 1:
            return group
        most, sides = self.most_items(kernel), list(group)
        if most < min(_FEWEST_ITEMS, math.prod(group)):
            subject, found = f"kernel {kernel.function_name} on {self.device.name}", f"groups of at most {most} work-items"
            raise DeviceError(subject, found, f"{_FEWEST_ITEMS} or more", "try another --device")
        while math.prod(sides) > most:
            sides[sides.index(max(sides))] //= 2
        return tuple(sides)

    def _tile(self, kernel: Kernel) -> tuple[int, int]:
        """Returns the (width, lines) of the tile of pixels that a GPU's work-group takes. The width is the number of
        work-items that run in lockstep, but at least 16 and at most 64. The lines fill the largest group that the device
        and the kernel allow, up to 256 work-items."""
        if self._multiple is None:
            rates = self.kernel("rates", "multiply_add")
            self._multiple = min(max(self._asked(rates, "PREFERRED_WORK_GROUP_SIZE_MULTIPLE"), 16), 64)
        most = min(_TILE_ITEMS, self.device.handle.max_work_group_size, self.most_items(kernel))
        width = min(self._multiple, most)
        return width, most // width

    def shape_of_lines(self, kernel: Kernel, width: int, *rows: int) -> tuple[tuple[int, ...], tuple[int, int], int]:
        """Returns the numbers of work-items, the work-group's sides and the number of groups for a kernel over ``rows`` (one
        count per axis) of ``width`` pixels. A work-item takes one row on a CPU, and one pixel on a GPU."""
        items, group = ((width, *rows), self._tile(kernel)) if self.pixel_items else ((1, *rows), (1, 1))
        sides = (*group, *([1] * (len(rows) - 1)))
        return items, group, math.prod(ceil_div(n, side) for n, side in zip(items, sides, strict=True))

    @naming_failures("the work before")
    def finish(self) -> None:
        self.queue.finish()
        self.traffic.count()

    def _record(self, name: str, event: "cl.Event", nbytes: int) -> None:
        if self.profile:
            self._profile.add(name, event, nbytes)

    def kernel_uses(self) -> dict[str, KernelUse]:
        """Returns what each kernel used since the last call, by falling total seconds. Needs ``profile=True``."""
        self.queue.finish()
        return self._profile.uses()

    def best_rates(self) -> Rates:
        """Measures how fast the device copies and calculates at best. Needs ``profile=True``."""
        kernel = self.compile(self.kernel("rates", "multiply_add"))
        return measure_rates(self.queue, kernel, self.lanes, self.device.compute_units, self.group())


def default_lanes(device: DeviceInfo) -> int:
    """Returns the number of floats in a kernel's vectors: a CPU's native width, or 1 on other devices."""
    if device.kind != "cpu":
        return 1
    return max((n for n in LANE_CHOICES if n <= device.vector_width), default=1)


def _parts(items: Sides, group: Sides, pieces: int) -> Iterator[tuple[Sides | None, Sides]]:
    """Divides a launch of ``items`` work-items per axis into at least ``pieces`` parts of whole work-groups. With fewer
    groups than ``pieces``, each group is a part. Yields (first item, number of items) of each part, both per axis. The
    first item of an undivided launch is None."""
    if pieces <= 1:
        yield None, items
        return
    cuts: list[list[tuple[int, int]]] = []
    for count, size in zip(reversed(items), reversed(group), strict=True):
        step = max(count // size // pieces, 1) * size
        cuts.insert(0, [(first, min(step, count - first)) for first in range(0, count, step)])
        pieces = ceil_div(pieces, len(cuts[0]))
    for part in product(*cuts):
        yield tuple(first for first, _ in part), tuple(count for _, count in part)


def _argument(value: Any) -> Any:
    if isinstance(value, DeviceArray):
        return value.buffer
    return np.int32(value) if type(value) in (bool, int) else np.float32(value) if type(value) is float else value


def _literal(value: int | float | bool) -> str:
    return str(int(value)) if isinstance(value, (bool, int, np.integer)) else f"{float(value):.9e}f"
