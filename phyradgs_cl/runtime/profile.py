"""Measures what each kernel uses: launches, seconds and bytes. OpenCL's events give the seconds. The bytes are the sizes of
a launch's buffers. For comparison, the driver's copies and a kernel of multiply-adds measure the device's best rates."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.runtime.opencl import cl

_FOLD_AT = 20_000  # number of events kept before their times are added up: this sum waits for the device
_COPY_BYTES = 1 << 26  # size of the copy that measures the memory's rate: larger than most caches
_STEPS = 20_000  # multiply-adds in each chain that measures the arithmetic rate; a quarter of them if ``lanes`` is 1
_REPEATS = 5  # number of runs of each measurement; the fastest counts


@dataclass
class KernelUse:
    """What one kernel used in a run: its launches, seconds, and the bytes of its launches' buffers."""

    launches: int = 0
    seconds: float = 0.0
    bytes: int = 0


class Profile:
    """Collects the events of a command queue that was made with profiling, and adds them up by kernel."""

    def __init__(self) -> None:
        self._events: list[tuple[str, cl.Event, int]] = []
        self._uses: dict[str, KernelUse] = defaultdict(KernelUse)

    def add(self, name: str, event: "cl.Event", nbytes: int) -> None:
        self._events.append((name, event, nbytes))
        if len(self._events) >= _FOLD_AT:
            self._fold()

    def uses(self) -> dict[str, KernelUse]:
        """Returns what each kernel used since the last call, by falling total seconds."""
        self._fold()
        uses = dict(sorted(self._uses.items(), key=lambda item: -item[1].seconds))
        self._uses = defaultdict(KernelUse)
        return uses

    def _fold(self) -> None:
        for name, event, nbytes in self._events:
            event.wait()
            use = self._uses[name]
            use.launches += 1
            use.seconds += (event.profile.end - event.profile.start) * 1e-9
            use.bytes += nbytes
        self._events.clear()


@dataclass(frozen=True)
class Rates:
    """The device's measured rates: bytes per second in a copy, where each byte counts twice (read and written), and
    floating-point operations per second."""

    copy_bytes_per_s: float
    flops_per_s: float


def profile_text(uses: dict[str, KernelUse], wall_s: float) -> str:
    """Returns a table of the kernels' ``uses``. Its last line compares their total seconds with ``wall_s``, the run's."""
    busy_s = sum(use.seconds for use in uses.values())
    rows = [("kernel", "launches", "seconds", "share", "ms each", "GB/s")]
    for name, use in uses.items():
        share, each_ms = use.seconds / max(busy_s, 1e-12), 1e3 * use.seconds / use.launches
        speed = use.bytes / use.seconds / 1e9 if use.seconds > 0 else 0.0
        numbers = f"{use.seconds:.3f}", f"{share:.1%}", f"{each_ms:.3f}", f"{speed:.1f}"
        rows.append((name, str(use.launches), *numbers))
    first, *others = (max(map(len, column)) for column in zip(*rows, strict=True))
    lines = ["  ".join([row[0].ljust(first), *map(str.rjust, row[1:], others)]) for row in rows]
    return "\n".join([*lines, f"kernels {busy_s:.2f} s of {wall_s:.2f} s ({busy_s / max(wall_s, 1e-12):.0%})"])


def measure_rates(
    queue: "cl.CommandQueue", multiply_add: "cl.Kernel", lanes: int, units: int, group: int
) -> Rates:
    """Measures the rates of copies and of the kernel ``multiply_add``, each as the best of 5 runs, on a ``queue`` with
    profiling. lanes: floats in the kernel's vectors. units: the device's compute units. group: size of a work-group."""
    context = queue.context
    source, target = (cl.Buffer(context, cl.mem_flags.READ_WRITE, _COPY_BYTES) for _ in range(2))
    cl.enqueue_fill_buffer(queue, source, np.zeros(1, np.float32), 0, _COPY_BYTES)
    copies = [cl.enqueue_copy(queue, target, source, byte_count=_COPY_BYTES) for _ in range(_REPEATS)]
    items = max(units, 1) * 16 * max(group, 1)
    steps = _STEPS if lanes > 1 else _STEPS // 4
    out = cl.Buffer(context, cl.mem_flags.READ_WRITE, 4 * items)
    multiply_add.set_args(np.int32(steps), np.float32(0.75), out)
    sums = [cl.enqueue_nd_range_kernel(queue, multiply_add, (items,), (group,)) for _ in range(_REPEATS)]
    queue.finish()
    best_copy_s, best_sum_s = (min(_seconds(e) for e in events) for events in (copies, sums))
    return Rates(2 * _COPY_BYTES / best_copy_s, 16.0 * lanes * steps * items / best_sum_s)


def _seconds(event: "cl.Event") -> float:
    return max((event.profile.end - event.profile.start) * 1e-9, 1e-9)
