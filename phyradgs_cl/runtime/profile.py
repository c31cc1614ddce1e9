"""A run's device time by kernel: launches, seconds and bytes. Seconds are those of OpenCL's events. Bytes count each buffer
of a launch once. The device's best rates are measured by copies of the driver and by a kernel of multiply-adds."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.runtime.opencl import cl

_FOLD_AT = 20_000  # most events that are kept; adding up more waits for the queue
_COPY_BYTES = 1 << 26  # bytes of the copy that measures the memory's rate
_STEPS = 20_000  # multiply-adds of each chain in the run that measures the arithmetic rate
_REPEATS = 5  # runs of each measurement, of which the fastest counts


@dataclass
class KernelUse:
    """Launches, seconds and bytes of one kernel in a run."""

    launches: int = 0
    seconds: float = 0.0
    bytes: int = 0


class Profile:
    """Collects the events of a queue that measures times."""

    def __init__(self) -> None:
        self._events: list[tuple[str, cl.Event, int]] = []
        self._uses: dict[str, KernelUse] = defaultdict(KernelUse)

    def add(self, name: str, event: "cl.Event", nbytes: int) -> None:
        self._events.append((name, event, nbytes))
        if len(self._events) >= _FOLD_AT:
            self._fold()

    def uses(self) -> dict[str, KernelUse]:
        """Returns the uses by kernel since the last call, the longest first."""
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
    """The device's measured rates: bytes moved (read and written), and floating-point operations, per second."""

    copy_bytes_per_s: float
    flops_per_s: float


def profile_text(uses: dict[str, KernelUse], wall_s: float) -> str:
    """Formats a table of ``uses`` (of ``Profile.uses``), with the kernels' fraction of ``wall_s``."""
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
    """Measures the rates of copies and of multiply-adds, each the best of a few runs. ``queue`` needs profiling."""
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
