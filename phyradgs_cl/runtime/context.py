"""A runtime: one device, one in-order queue, the programs built for the device, and its buffers."""

import logging
import math
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
from phyradgs_cl.runtime.opencl import Kernel, cl, kernel_source, naming_failures
from phyradgs_cl.runtime.profile import KernelUse, Profile, Rates, measure_rates

log = logging.getLogger(__name__)
Sides = tuple[int, ...]

LANE_CHOICES = (1, 4, 8, 16)
_FUSING, _PAIRS = "-cl-mad-enable", '#line 1 "common/precise.h"'
_TILE_ITEMS = 256  # most work-items of a work-group that shares a tile
_FEWEST_ITEMS = 32  # least number of work-items that a kernel must be able to run in one work-group


class Runtime:
    """Owns everything OpenCL. First declare (``kernel``), then allocate (``empty``, ``upload``), then call (``launch``).

    - lanes: the width of vectors in kernels. It is wide on CPUs; on GPUs, where work-items are the lanes, it is 1. None
      takes the device's width.
    - fp64: False selects the fallback by pairs of float32.
    - pixel_items: the launch shape. True is a work-item per pixel in small groups (GPUs, needs ``lanes`` 1), False a
      work-item per band of lines (CPUs).
    - memory: the limit of the sum of its buffers in bytes, or as text like 2GiB.
    - ranks: the processes that work on the same scan, each with its own Runtime. Where a machine has several devices, each
      rank takes the next device."""

    # Most samples of rays in one GPU launch: a display driver kills launches of seconds; this takes 0.1 s on a slow GPU.
    most_samples = 2**29

    def __init__(
        self, device: str | None = None, *, lanes: int | None = None, fp64: bool | None = None,
        pixel_items: bool | None = None, profile: bool = False, memory: str | int | None = None,
        ranks: Communicator | None = None,
    ) -> None:
        limit_bytes = memory_limit(memory)
        self.ranks = Communicator() if ranks is None else ranks
        self.device: DeviceInfo
        self.device, self.reason = choose_device(device, self.ranks.local_rank)
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
        # A CPU's driver may allocate at a buffer's first use, and end the process where memory is short.
        at_once = cl.mem_flags.ALLOC_HOST_PTR if self.device.kind == "cpu" else 0
        self._memory_flags = cl.mem_flags.READ_WRITE | at_once
        self.profile = profile
        self._multiple: int | None = None
        self._profile = Profile()
        self._programs: dict[tuple[str, tuple[str, ...]], cl.Program] = {}
        self._kernels: dict[tuple[str, str, tuple[str, ...]], Kernel] = {}

    def kernel(self, program: str, name: str, **defines: int | float | bool) -> Kernel:
        """Declares the kernel ``name`` of ``cl/<program>.cl``. The first launch builds it, once for all its declarations."""
        merged: dict[str, int | float | bool] = {"LANES": self.lanes, "FP64": int(self.fp64), **defines}
        flags = [f"-D{name}={_literal(value)}" for name, value in sorted(merged.items())]
        key = (program, name, ("-cl-std=CL1.2", _FUSING, *flags))
        return self._kernels.setdefault(key, Kernel(*key))

    def compile(self, kernel: Kernel) -> "cl.Kernel":
        """Returns the built kernel. A program is built once for all its kernels."""
        if kernel.built is None:
            key = (kernel.program, kernel.options)
            if key not in self._programs:
                self._programs[key] = self._build(*key)
            kernel.built = cl.Kernel(self._programs[key], kernel.function_name)
        return kernel.built

    @property
    def built_kernels(self) -> set[str]:
        """The names of the kernels that have been launched."""
        return {kernel.function_name for kernel in self._kernels.values() if kernel.built is not None}

    @property
    def group_limits(self) -> dict[str, int]:
        """The largest work-group in work-items, by name, of the kernels that ``most_items`` was called for."""
        return {one.function_name: one.most_items for one in self._kernels.values() if one.most_items is not None}

    def _build(self, program: str, options: tuple[str, ...]) -> "cl.Program":
        started = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", cl.CompilerWarning)
                source = kernel_source(program)
                built = cl.Program(self.context, source).build(options=self._allowed(source, options))
        except cl.Error as error:
            message_lines = [line for line in str(error).splitlines() if "error:" in line]
            message = " ".join((message_lines or str(error).splitlines())[:3])[:600]
            subject, remedy = f"kernel {program}.cl on {self.device.name}", "try another --device"
            raise DeviceError(subject, message, "a program that builds", remedy) from error
        log.debug("built %s in %.2f s", program, time.perf_counter() - started)
        return built

    @staticmethod
    def _allowed(source: str, options: tuple[str, ...]) -> list[str]:
        """Returns the build options. Sums of pairs of floats lose the option that fuses multiply and add, because some
        drivers ignore the pragma against it."""
        has_pairs = "-DFP64=0" in options and _PAIRS in source
        return [option for option in options if not (has_pairs and option == _FUSING)]

    def empty(self, shape: int | Sequence[int], dtype: np.typing.DTypeLike = np.float32) -> DeviceArray:
        """Returns uninitialised memory. Raises MemoryShortage where the device, or the limit, has too little."""
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
        """Returns the memory in bytes that an operator may plan with now, in all and in one buffer."""
        return self.ledger.room(self.device.largest_allocation_bytes)

    @property
    def peak_bytes(self) -> int:
        """The most device memory in use at one time, since the start or the last ``reset_peak``."""
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
        """Copies host values (same size) into an existing array. The host array may be reused afterwards."""
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
        """Returns element ``index`` of a flat array, after all work enqueued before."""
        value = np.empty(1, array.dtype)
        offset = index * array.dtype.itemsize
        cl.enqueue_copy(self.queue, value, array.buffer, src_offset=offset, is_blocking=True)
        self.traffic.count(down=value.nbytes)
        return value[0]

    @naming_failures("a copy from it")
    def read_item_later(self, array: DeviceArray, index: int) -> LaterItem:
        """Returns element ``index`` of a flat array as it will be after the work enqueued so far, without waiting for the
        device."""
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
        """Copies bytes of one device array to another: the whole source, or ``nbytes`` from and to the offsets."""
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
        """Enqueues at least ``items`` work-items, rounded up to whole work-groups: a kernel must do nothing past its last
        item.

        group: the sides of a work-group, missing ones 1. An int is a number of work-items along the first axis; on a GPU
        they also lie along other axes where the first is short. Sides are halved until the kernel can run. samples: the
        work of all items, as the number of ray samples that take as long to read; on a GPU more than ``most_samples`` are
        divided among launches. Items then keep their global ids, and groups get new ones. Python's whole numbers become
        int, its other numbers float: give np.int64 for a long, and np.float32 for a float that may be whole. Raises
        DeviceError, or MemoryShortage, where a launch fails."""
        shape = (items,) if isinstance(items, (int, np.integer)) else items
        if min(shape) < 1:
            return
        given = (*group, *([1] * (len(shape) - len(group)))) if isinstance(group, tuple) else self._sides(group, shape)
        local = self._fitting(kernel, given)
        rounded = tuple(ceil_div(int(n), size) * size for n, size in zip(shape, local, strict=True))
        arrays = [a for a in args if isinstance(a, DeviceArray)]
        nbytes = sum(a.nbytes for a in arrays) if self.profile else 0
        pieces = ceil_div(samples, self.most_samples) if self.pixel_items else 1
        try:  # no decorator: a step has thousands of launches
            built = self.compile(kernel)
            built.set_args(*map(_argument, args))
            for first, part in _parts(rounded, local, pieces):
                event = cl.enqueue_nd_range_kernel(self.queue, built, part, local, first)
                self._record(kernel.function_name, event, nbytes if first is None or not any(first) else 0)
                if first is not None:
                    self.queue.flush()  # or the driver may hand over several as one
        except cl.Error as error:
            raise self.ledger.error(f"a launch of {kernel.function_name}", error, self.queue) from error

    def _sides(self, items: int, shape: Sides) -> Sides:
        """Returns the sides of a work-group of ``items``: all along the first axis. On a GPU with a shorter first axis
        the rest goes along another axis that it divides, because items past the end would idle."""
        sides = [int(items), *([1] * (len(shape) - 1))]
        while self.pixel_items and sides[0] % 2 == 0 and sides[0] // 2 >= shape[0]:
            axis = next((k for k in range(1, len(shape)) if shape[k] % (2 * sides[k]) == 0), None)
            if axis is None:
                break
            sides[0], sides[axis] = sides[0] // 2, 2 * sides[axis]
        return tuple(sides)

    def group(self, on_cpu: int = 1, on_gpu: int = 64, *kernels: Kernel) -> int:
        """Returns the work-items of a work-group for this kind of device. A GPU's number is halved until all ``kernels``
        can run in it: their items share local memory, so ``launch`` must not halve it."""
        while self.pixel_items and any(on_gpu > self.most_items(kernel) for kernel in kernels):
            on_gpu //= 2
        return on_gpu if self.pixel_items else on_cpu

    def most_items(self, kernel: Kernel) -> int:
        """Returns the largest work-group, in work-items, in which a kernel can run. Its registers may allow fewer than
        the device."""
        if kernel.most_items is None:
            kernel.most_items = self._asked(kernel, "WORK_GROUP_SIZE")
        return kernel.most_items

    def _asked(self, kernel: Kernel, name: str) -> int:
        return int(self.compile(kernel).get_work_group_info(getattr(cl.kernel_work_group_info, name), self.device.handle))

    def _fitting(self, kernel: Kernel, group: tuple[int, ...]) -> tuple[int, ...]:
        """Returns sides of a work-group, halved until the kernel can run in them. Raises DeviceError below 32
        work-items."""
        if math.prod(group) == 1:
            return group
        most, sides = self.most_items(kernel), list(group)
        if most < min(_FEWEST_ITEMS, math.prod(group)):
            subject, found = f"kernel {kernel.function_name} on {self.device.name}", f"groups of at most {most} work-items"
            raise DeviceError(subject, found, f"{_FEWEST_ITEMS} or more", "try another --device")
        while math.prod(sides) > most:
            sides[sides.index(max(sides))] //= 2
        return tuple(sides)

    def tile(self, kernel: Kernel | None = None) -> tuple[int, int]:
        """Returns (width, lines) of a work-group's tile of pixels on a GPU: as wide as items run in lockstep, and as many
        lines as ``kernel``, or the device, allows."""
        rates = self.kernel("rates", "multiply_add")
        if self._multiple is None:
            self._multiple = min(max(self._asked(rates, "PREFERRED_WORK_GROUP_SIZE_MULTIPLE"), 16), 64)
        most = min(_TILE_ITEMS, self.device.handle.max_work_group_size, self.most_items(kernel or rates))
        width = min(self._multiple, most)
        return width, most // width

    def shape_of_lines(self, kernel: Kernel, width: int, *rows: int) -> tuple[tuple[int, ...], tuple[int, int], int]:
        """Returns work-items, work-group and number of groups of a kernel over ``rows`` of ``width`` pixels. A work-item
        takes a whole line on a CPU, and a pixel on a GPU."""
        items, group = ((width, *rows), self.tile(kernel)) if self.pixel_items else ((1, *rows), (1, 1))
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
        """Returns launches, seconds and bytes by kernel since the last call, the longest time first. Needs
        ``profile=True``."""
        self.queue.finish()
        return self._profile.uses()

    def best_rates(self) -> Rates:
        """Measures the device's best rates: bytes copied and floating-point operations per second. Needs
        ``profile=True``."""
        kernel = self.compile(self.kernel("rates", "multiply_add"))
        return measure_rates(self.queue, kernel, self.lanes, self.device.compute_units, self.group())


def default_lanes(device: DeviceInfo) -> int:
    """Returns the vector width: a CPU's native width, or 1 where work-items are the lanes."""
    if device.kind != "cpu":
        return 1
    return max((n for n in LANE_CHOICES if n <= device.vector_width), default=1)


def _parts(items: Sides, group: Sides, pieces: int) -> Iterator[tuple[Sides | None, Sides]]:
    """Yields the first item and the number of work-items, per axis, of each of ``pieces`` launches or more; whole groups
    stay together. One piece has None as its first item."""
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
