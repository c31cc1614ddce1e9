"""Measures every kernel and six whole jobs, and compares them with the table of this kind of processor (the ledger).

    python benchmarks/kernels.py [--quick] [--write] [--all] [--json FILE] [--device D]

It runs short reconstructions of 64³ voxels from 128² pixels, and of 128³ from 256², with every motion model that has kernels
of its own. A kernel's time is the least of its runs, in ns per voxel of the volume. It is divided by the time in which this
machine copies a float, and by that of a multiply-add. The smaller of the two quotients is compared with kernels.json. What
seems slower is measured again, up to three times. Jobs are compared by their processor time over that of a fixed loop; on a
GPU they do not run.

Prints a line for each that takes 1.3 times as long as in the table, and then ends with 1. --quick: the small size, and half
of the jobs. --write: puts this run in the table. --all: prints every kernel with its share of the machine's rate of copying.
It takes four minutes on two cores, or 50 s with --quick."""

import json
import resource
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from measuring import parser_of

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, perturb
from phyradgs_cl.api import reconstruct, simulate, splat_operator, voxel_operator
from phyradgs_cl.fields import Deformation, Gaussians
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.pocl import cpu_facts
from phyradgs_cl.runtime.profile import KernelUse, Rates

TABLE = Path(__file__).with_suffix(".json")
SLOWER = 1.3
_REPEATS = 2
_TRIES = 3  # of a work that seems slower
_LEAST_S = 2e-4  # time of a kernel in one run, below which the measurement is not good
SIZES = (64, 128)
JOBS: dict[str, tuple[int, str, dict[str, object]]] = {
    "default, S": (64, "fista", {"iterations": 5}),
    "sirt, per-row": (64, "sirt", {"iterations": 10, "motion": "per-row"}),
    "phyradgs, exact": (64, "phyradgs", {"iterations": 60}),
    "default, M": (128, "fista", {"iterations": 2}),
    "fista-tv, M": (128, "fista-tv", {"iterations": 5, "motion": "per-row"}),
    "fdk, M": (128, "fdk", {"motion": "static"}),
}
"""Voxels along a side, method, options. --quick runs the first half."""
Table = dict[str, list[float]]
"""By the name of a kernel's work: its ns per voxel over those of copying a float, and over those of a multiply-add."""


@cache
def foot(size: int, views: int = 6, protocol: str = "rapid", readout: str = "rows") -> Scan:
    """Returns a fly-scan with twice as many pixels as voxels along a side."""
    return simulate("foot", size=size, detector=2 * size, views=views, protocol=protocol, readout_axis=readout)


def moving(scan: Scan) -> Deformation:
    """Returns a field of a voxel's size, with one oscillation in the scan."""
    control_mm = np.random.default_rng(0).uniform(-1, 1, (2, 4, 4, 4, 3)) * max(scan.grid.voxel_size_mm)
    spacing_mm = max(scan.grid.size_mm) / 3
    first_mm = tuple(-spacing_mm * 1.5 for _ in range(3))
    times_s = np.linspace(scan.frame_start_s[0], scan.frame_start_s[-1] + scan.shutter.span_s, 5)
    phase = np.linspace(0, 2 * np.pi, 5)
    return Deformation(control_mm, first_mm, spacing_mm, times_s, np.stack([np.sin(phase), np.cos(phase)], -1))


def works(size: int) -> Iterator[tuple[str, Callable[[Runtime], object]]]:
    """Yields names and runs whose kernels differ."""
    scan = foot(size)
    leaning = perturb(scan, GeometryCorrection(roll_rad=0.005, tilt_v_rad=0.01))
    columns, steep = foot(size, readout="columns"), perturb(scan, GeometryCorrection(tilt_v_rad=0.6))
    averaging = replace(scan, detector_model="intensity")

    def runs(of: Scan, method: str, **options: object) -> Callable[[Runtime], object]:
        return lambda rt: reconstruct(of, method, device=rt, report=False, **options)  # type: ignore[arg-type]

    few = {"iterations": 1}
    splats = {"iterations": 12, "gaussians": size**3 // 16, "tv_edge": 32}
    yield "fista", runs(scan, "fista", subvoxels=1, **few)
    yield "asd-pocs", runs(scan, "asd-pocs", motion="static", **few)
    for name, of in {"still": foot(size, protocol="static"), "leaning": leaning, "columns": columns, "steep": steep}.items():
        yield f"cgls, {name}", runs(of, "cgls", motion="per-row", **few)
    yield "sirt, own times", runs(scan, "sirt", motion="own-times", sub_intervals=2, **few)
    yield "sirt, averages of intensity", runs(averaging, "sirt", motion="per-row", **few)
    yield "sirt, moving object", runs(scan, "sirt", motion="static", object_motion=moving(scan), **few)
    yield "changing", runs(scan, "changing", **few)
    yield "fdk", runs(scan, "fdk", motion="static")
    yield "fdk, leaning", runs(leaning, "fdk", motion="static")
    yield "fdk, steep", runs(steep, "fdk", motion="static")
    yield "fdk, per-row", runs(scan, "fdk", motion="per-row")
    yield "fdk, moving object", runs(scan, "fdk", motion="static", object_motion=moving(scan))
    yield "fdk, moving object, per-row", runs(scan, "fdk", motion="per-row", object_motion=moving(scan))
    for motion in ("static", "exact", "micro-views"):
        yield f"phyradgs, {motion}", runs(scan, "phyradgs", motion=motion, **splats)
    yield "phyradgs, averages of intensity", runs(averaging, "phyradgs", motion="micro-views", **splats)
    yield "phyradgs, moving object", runs(scan, "phyradgs", object_motion=moving(scan), **splats)
    yield "operators", partial(operators, scan)


def operators(scan: Scan, rt: Runtime) -> None:
    """Runs the operators that users call in loops of their own, on plain arrays."""
    rng, half_mm = np.random.default_rng(0), scan.grid.half_longest_mm
    count = scan.grid.shape[0] ** 3 // 16
    mean, scales = rng.uniform(-0.6, 0.6, (count, 3)) * half_mm, rng.uniform(0.01, 0.04, (count, 3)) * half_mm
    cloud = Gaussians(mean, scales, np.tile([1.0, 0, 0, 0], (count, 1)), rng.uniform(0, 1, count))
    for operator in (splat_operator(scan, "static", device=rt), voxel_operator(scan.grid, device=rt)):
        y, back = operator.vjp(cloud)
        back(y)


def uses_of(rt: Runtime, run: Callable[[Runtime], object]) -> tuple[dict[str, KernelUse], Rates]:
    """Returns the least use of every kernel in some runs, and the machine's rates beside them."""
    rates = rt.best_rates()
    uses: list[dict[str, KernelUse]] = []
    for _ in range(_REPEATS):
        run(rt)
        uses.append(rt.kernel_uses())
    return {kernel: min((one[kernel] for one in uses), key=lambda use: use.seconds) for kernel in uses[0]}, rates


def measure(rt: Runtime, sizes: tuple[int, ...], table: Table) -> tuple[Table, dict[str, tuple[float, float]]]:
    """Returns the two quotients of every kernel by "KERNEL: work, size³", and its ns per voxel with its share of copying.

    A work with a kernel slower than in ``table`` runs again, because other programs slow single runs down by half."""
    least: Table = {}
    kernels: dict[str, tuple[float, float]] = {}
    for size in sizes:
        for name, run in works(size):
            run(rt)  # this compiles
            rt.kernel_uses()
            for _ in range(_TRIES):
                uses, rates = uses_of(rt, run)
                now: Table = {}
                for kernel, use in uses.items():
                    if use.seconds > _LEAST_S:
                        ns, key = 1e9 * use.seconds / size**3, f"{kernel}: {name}, {size}³"
                        float_ns, flop_ns = 8e9 / rates.copy_bytes_per_s, 2e9 / rates.flops_per_s  # a copy reads and writes
                        now[key] = [round(ns / float_ns, 3), round(ns / flop_ns, 2)]
                        kernels[key] = ns, use.bytes / use.seconds / rates.copy_bytes_per_s
                least |= {key: [min(pair) for pair in zip(now[key], least.get(key, now[key]), strict=True)] for key in now}
                if not slower({key: least[key] for key in now}, table):
                    break
            print(f"{name}, {size}³", file=sys.stderr)
    return least, kernels


def loop(rt: Runtime) -> None:
    """Runs the fixed work to which jobs are compared: copies and multiply-adds."""
    for _ in range(4):
        rt.best_rates()


def processor_s(work: Callable[[], object]) -> float:
    """Returns the processor seconds of this process and its threads."""
    before = resource.getrusage(resource.RUSAGE_SELF)
    work()
    after = resource.getrusage(resource.RUSAGE_SELF)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure_jobs(rt: Runtime, names: list[str]) -> dict[str, float]:
    """Returns the processor time of jobs over that of the loop, which runs before and after each."""
    ratios = {}
    for name in names:
        size, method, options = JOBS[name]
        job = partial(reconstruct, foot(size, views=25), method, device=rt, report=False, **options)
        around_s = [processor_s(partial(loop, rt))]
        job_s = processor_s(job)
        around_s.append(processor_s(partial(loop, rt)))
        ratios[f"job {name}"] = job_s / min(around_s)
        print(f"job {name}: {job_s:.1f} processor s, {ratios[f'job {name}']:.2f} loops", file=sys.stderr)
    return ratios


def kind_of(rt: Runtime) -> str:
    """Names the kind of processor whose table is right: its maker, and the instructions for which kernels are built."""
    maker = f"{cpu_facts().get('vendor_id', 'unknown')} " if rt.device.kind == "cpu" else ""
    return f"{maker}{rt.device.target or rt.device.name}"


def slower(now: Table, table: Table) -> list[str]:
    """Returns a line for everything that takes ``SLOWER`` times as long as in the table by both of its quotients."""
    times = {name: min(new / old for new, old in zip(now[name], table[name], strict=True)) for name in now if name in table}
    worst_first = sorted(times.items(), key=lambda item: -item[1])
    return [f"slower: {name} {ratio:.1f} times" for name, ratio in worst_first if ratio > SLOWER]


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--write", action="store_true", help="put this run in the table of this kind of processor")
    parser.add_argument("--all", action="store_true", help="print every kernel")
    given = parser.parse_args()
    rt = Runtime(given.device, profile=True)
    sizes, jobs = (SIZES[:1], list(JOBS)[: len(JOBS) // 2]) if given.quick else (SIZES, list(JOBS))
    tables: dict[str, Table] = json.loads(TABLE.read_text()) if TABLE.is_file() else {}
    kind = kind_of(rt)
    now, kernels = measure(rt, sizes, {} if given.write else tables.get(kind, {}))
    if rt.device.kind == "cpu":
        now |= {name: [round(ratio, 3)] for name, ratio in measure_jobs(rt, jobs).items()}
    if given.all:
        for name, (ns, share) in sorted(kernels.items(), key=lambda item: item[1][1]):
            print(f"{name:60s} {ns:9.2f} ns  {share:6.0%} of copying")
    if given.json:
        copy_GB_per_s = rt.best_rates().copy_bytes_per_s / 1e9
        given.json.write_text(json.dumps({"kind": kind, "copy_GB_per_s": copy_GB_per_s, "all": now}) + "\n")
    if given.write:
        tables[kind] = {**tables.get(kind, {}), **now}
        rows = ",\n".join(f"  {json.dumps(k)}: {{\n" + ",\n".join(
            f"    {json.dumps(name, ensure_ascii=False)}: {json.dumps(row)}" for name, row in sorted(t.items())
        ) + "\n  }" for k, t in sorted(tables.items()))  # fmt: skip
        TABLE.write_text(f"{{\n{rows}\n}}\n", encoding="utf-8")
    elif kind not in tables:
        sys.exit(f"{TABLE.name} has no table of {kind}: --write makes one, from code that is known to be fast")
    lines = slower(now, tables[kind])
    print("\n".join(lines) or f"nothing of {len(now)} takes {SLOWER} times as long as in the table of {kind}")
    sys.exit(1 if lines else 0)


if __name__ == "__main__":
    main()
