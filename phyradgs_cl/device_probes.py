"""Facts of a device that `phyradgs devices --check` prints: how it rounds, what it allows, how long a launch may last, and
its speed. They help to find out why results on a user's device differ from those on another."""

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from phyradgs_cl.errors import DeviceError
from phyradgs_cl.runtime import Runtime

LASTING_S = 0.1, 1.0, 3.0
"""Durations in s of trial launches on GPUs. The driver of a GPU with a screen ends a launch that lasts over 2 to 5 s."""
# Largest relative error of sums of float pairs. If a compiler simplifies the pairs away, the error is a float's: 6e-8.
PAIRS = 1e-12
_ITEMS = 32  # number of work-items in a work-group of the probes
_TRIED_STEPS = 1 << 14  # multiply-adds of a first short launch; its time per step gives the steps of longer launches


def pair_error(rt: Runtime) -> float:
    """Returns the largest relative error of sums in which two floats stand for a float64. It is at most ``PAIRS`` unless
    the driver's compiler simplifies the pairs away."""
    (x, y, z), sums = np.random.default_rng(1).uniform(0.5, 1, (3, 256)).astype(np.float32), rt.empty((256, 2))
    kernel = rt.kernel("probes", "probe_pairs", LANES=1, FP64=0)
    rt.launch(kernel, 256, *map(rt.upload, (x, y, z)), 256, sums, group=rt.group(on_cpu=16))
    expected = x + y.astype(np.float64) * z
    return float(np.abs(rt.download(sums).astype(np.float64).sum(1) / expected - 1).max())


def carried(rt: Runtime) -> tuple[bool, bool, bool]:
    """Returns the results of three tests of the device: whether local memory keeps ints, whether it keeps ints stored as
    floats of the same bits, and whether subnormal floats are not flushed to 0."""
    numbers, tiny = np.arange(-8, _ITEMS - 8, dtype=np.int32), np.float32(1e-40)
    as_ints, as_floats, twice = rt.zeros(_ITEMS, np.int32), rt.zeros(_ITEMS), rt.zeros(_ITEMS, np.int32)
    kernel = rt.kernel("probes", "probe_numbers", LANES=1, FP64=0)
    rt.launch(kernel, _ITEMS, rt.upload(numbers), tiny, as_ints, as_floats, twice, group=_ITEMS)
    found = rt.download(as_ints), rt.download(as_floats).view(np.int32)
    is_kept = bool((rt.download(twice).view(np.float32) == 2 * tiny).all())
    return bool((found[0] == numbers[::-1]).all()), bool((found[1] == numbers[::-1]).all()), is_kept


def longest_launch(make: Callable[[], Runtime], lasting_s: Sequence[float]) -> str:
    """Tries launches of about ``lasting_s`` seconds until one fails. Returns in words how long a launch may last.

    make: returns a new Runtime for each try. After a driver has ended a launch, nothing works in its OpenCL context."""
    lived_s, steps = 0.0, _TRIED_STEPS
    for wanted_s in (0.01, *lasting_s):
        try:
            rt = make()
            _spin(rt, 1)  # builds the kernel, so that its build is not timed
            each_s = max(lived_s or _spin(rt, steps), 1e-6) / steps
            steps = int(min(wanted_s / each_s, 2**31 - 1))
            lived_s = _spin(rt, steps)
        except DeviceError:
            return f"{lived_s:.2g} s; the driver ended one of {wanted_s:g} s"
    return f"{lived_s:.2g} s or more"


def _spin(rt: Runtime, steps: int) -> float:
    """Returns the seconds that one work-group takes for ``steps`` multiply-adds, each with the previous one's result."""
    out, started = rt.zeros(_ITEMS), time.perf_counter()
    rt.launch(rt.kernel("rates", "multiply_add"), _ITEMS, steps, np.float32(0.5), out, group=_ITEMS)
    rt.finish()
    return time.perf_counter() - started


def probe_lines(device: str | None, limits: dict[str, int], check_s: float, **launch_shape: bool | int) -> Iterator[str]:
    """Yields lines of text about a device: driver, rounding, work-groups, speed and, on GPUs, the longest launch.

    limits: each kernel's largest work-group, in work-items. check_s: seconds that the comparison of kernels took.
    launch_shape: options of ``Runtime``. If a probe raises DeviceError, the error's message is the last line."""

    def make(profile: bool = False) -> Runtime:
        return Runtime(device, profile=profile, **launch_shape)  # type: ignore[arg-type]

    rt = make(profile=True)
    try:
        yield f"driver {rt.device.platform}, {rt.device.version}, {rt.device.handle.driver_version}"
        error, (ints, floats, subnormals) = pair_error(rt), carried(rt)
        use = "" if rt.fp64 else ", which stand for float64 here"
        yield f"pairs of floats{use}: {'kept' if error <= PAIRS else 'contracted'}, relative error {error:.1e}"
        kept = {True: "kept", False: "changed"}
        yield f"whole numbers through local memory: {kept[ints]}, as floats {kept[floats]}"
        yield f"subnormal floats: {'kept' if subnormals else 'flushed to 0'}"
        fewest = f", of {min(limits, key=limits.__getitem__)} at most {min(limits.values())}" if limits else ""
        yield f"work-items of a group: {rt.device.handle.max_work_group_size}{fewest}"
        rates = rt.best_rates()
        speed = f"copies {rates.copy_bytes_per_s / 1e9:.3g} GB/s, multiply-adds {rates.flops_per_s / 1e9:.3g} Gflop/s"
        yield f"times: all kernels built and compared in {check_s:.1f} s; {speed}"
        if rt.pixel_items:
            yield f"longest launch that lived: {longest_launch(make, LASTING_S)}"
    except DeviceError as failure:
        yield f"a probe failed: {failure}"
