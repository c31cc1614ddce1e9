"""What a GPU would take for an iteration, on paper: instructions counted, bytes reckoned, against published peaks.

    OCLGRIND=.venv-oclgrind/bin/python python benchmarks/cost_model.py [--quick] [--json FILE] [--table FILE]

No GPU is needed and none is asked: the figures are a model's. Oclgrind (``make test-oclgrind`` unpacks it; OCLGRIND names
the Python that has it) runs every kernel of an iteration in a GPU's launch shape on a small part of the problem and counts
what its work-items execute. A stated law takes that to the full problem, whose pairs, footprints, lists, cells are counted
there by running what prepares them. Bytes are each array once, at what of it is touched. A kernel takes the longer of
instructions over issue rate and bytes over bandwidth; launches, waiting for memory and lanes that idle are not in it.
"""



import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from measuring import Facts, finish, parser_of
from splat_speed import cloud

from phyradgs_cl.acquisition import ConeGeometry, Exact, Scan, make_protocol
from phyradgs_cl.acquisition.cells import exact_cells, micro_view_cells, segments_for, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Activation, Grid
from phyradgs_cl.objective import ImageLoss, TotalVariation
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector, Voxeliser
from phyradgs_cl.operators.splats.binning import _SCANNED
from phyradgs_cl.operators.splats.projector import RECORD_FLOATS
from phyradgs_cl.optim import DeviceAdam
from phyradgs_cl.reconstructors import RunPlan, method_options, reconstruct
from phyradgs_cl.runtime import DeviceArray, Kernel, Runtime
from phyradgs_cl.runtime.layout import pad_rows, pitch_of

Counts = dict[str, float]
Costs = dict[str, tuple[float, float]]
"""Of each kernel in an iteration: instructions of all work-items, bytes."""

# FP32 operations and bytes per second, as published; a multiply-add is one instruction and two operations
PEAKS = {"RTX 4090": (82.6e12, 1.008e12), "H200": (67e12, 4.8e12)}
TILE = (32, 8)  # of NVIDIA's, whose preferred multiple is 32
LINES, COUNT, STRIPS, TIMES, TV_EDGE = 512, 50_000, 8, 5, 32
CROP = LINES // STRIPS  # lines and pixels that Oclgrind sees: one strip
FEW_SEEN, FEW = 48, 8  # Oclgrind sees one Gaussian in so many: of those that the crop sees, and of all
MOTIONS = ("static", "8x5", "exact")
VOXELS, VIEWS, FEW_VIEWS = 256, 25, 3  # of FISTA-TV, on a panel of 512²
EDGE = 12  # of its volume that Oclgrind sees, on a panel of twice as many pixels
FREE = ("phi", "bitcast", "alloca", "ret", "getelementptr", "load private", "store private", "zext", "sext", "trunc")
"""What is no instruction of a GPU: registers, and the widening of indices, which addresses have built in."""
UNIT = {
    "splat_prepare": "gaussian_cells", "splat_chain": "footprints", "splat_forward_pixels": "pairs",
    "splat_backward_group": "pairs", "bin_count_group": "entries", "bin_fill_group": "entries",
    "bin_within_group": "scans", "bin_starts_group": "tiles",
}  # fmt: skip
"""What a kernel's instructions grow with; "pixels" where nothing is said."""


START = "what follows is an iteration"
NOTED: list[tuple[str, int]] = []

# --- counting ----------------------------------------------------------------------------------------------------


def instructions(report: str) -> list[tuple[str, float]]:
    """Kernels in the order of their launches, with what all work-items of each have executed."""
    found = []
    for part in report.split("Instructions executed for kernel '")[1:]:
        name, _, body = part.partition("'")
        lines = re.findall(r"^ +(\d+) - (.+)$", body, re.M)
        found.append((name, sum(float(n) for n, what in lines if not what.startswith((*FREE, "call llvm.lifetime")))))
    return found


def note_launches() -> None:
    """Puts the name of every kernel that is launched from now on into ``NOTED``, with the bytes of its arrays."""
    launch = Runtime.launch

    def noting(self: Runtime, kernel: Kernel, items: int | tuple[int, ...], *args: object, **options: object) -> None:
        if np.min(items) >= 1:
            nbytes = sum(a.nbytes for a in args if isinstance(a, DeviceArray))
            NOTED.append((kernel.function_name, nbytes))
        launch(self, kernel, items, *args, **options)  # type: ignore[arg-type]

    Runtime.launch = noting  # type: ignore[method-assign,assignment]


def counted(case: str) -> tuple[list[tuple[str, float, float]], Counts]:
    """(kernel, instructions, bytes) of a case's launches from ``START`` on, under Oclgrind, and the case's own counts."""
    python = os.environ.get("OCLGRIND", sys.executable)
    environment = {**os.environ, "OCLGRIND_INST_COUNTS": "1"}
    done = subprocess.run([python, __file__, "--case", case], env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{case}: {done.stderr[-2000:]}")
    noted, counts = json.loads(done.stderr.strip().splitlines()[-1])
    start = next((k for k, (name, _) in enumerate(noted) if name == START), -1)
    launched = noted[start + 1 :]
    executed = instructions(done.stdout)[-len(launched) :]
    if [name for name, _ in launched] != [name for name, _ in executed]:
        raise RuntimeError(f"{case}: {len(launched)} launches, {len(executed)} reports")
    return [(name, count, nbytes) for (name, count), (_, nbytes) in zip(executed, launched, strict=True)], counts


# --- splats ------------------------------------------------------------------------------------------------------


def table_of(motion: str, pixels: int) -> TimeCells:
    """The cells of a frame of ``pixels``², at the pitch and the time per line of the whole panel."""
    protocol = make_protocol("rapid")
    geometry = ConeGeometry(5.0, 7.0, (pixels, pixels), (4.0 / LINES,) * 2)
    orbit, start_s, whole = protocol.orbit(geometry), float(protocol.frame_start_s()[3]), protocol.shutter()
    shutter = replace(whole, readout_s=whole.readout_s * pixels / LINES)
    where = orbit, shutter, 3, start_s, pixels
    if motion == "static":
        return static_cells(*where)
    if motion == "8x5":
        return micro_view_cells(*where, STRIPS * pixels // LINES, TIMES)
    segments = segments_for(orbit, whole, 3, start_s, Exact().time_error)
    return exact_cells(*where, max(round(segments * shutter.span_s / whole.span_s), 1))


def drawn(
    rt: Runtime, motion: str, pixels: int, rows: np.ndarray
) -> tuple[SplatProjector, DeviceGaussians, DeviceCells, Counts]:
    """A projector that has prepared and listed a cloud, what it was given, and how much there is of everything."""
    rt._tile = TILE
    cells, gaussians = DeviceCells.upload(rt, table_of(motion, pixels)), DeviceGaussians.upload(rt, rows)
    projector = SplatProjector(rt, pixels, pixels)
    work = projector.work(gaussians, cells)
    projector.lists.build(projector._extents, gaussians.count, gaussians.stride)
    counts = {
        "gaussians": gaussians.count, "cells": cells.count, "gaussian_cells": gaussians.stride * cells.count,
        "footprints": work.footprints, "pairs": work.pairs, "pixels": pixels**2, "tiles": projector.lists.total,
        "entries": int(rt.read_item(projector.lists.starts, projector.lists.total)),
        "counts": projector.lists._counts.size,
        "scans": projector.lists.total * -(-projector.lists._counts.size // (projector.lists.total * _SCANNED)),
    }  # fmt: skip
    return projector, gaussians, cells, {name: float(count) for name, count in counts.items()}


def seen_by_crop(motion: str) -> np.ndarray:
    """One in ``FEW_SEEN`` of the Gaussians that the middle of the panel sees, parameter rows (11, G)."""
    rt, rows = Runtime(lanes=1, pixel_items=True), cloud(COUNT, LINES, np.random.default_rng(0))
    projector, gaussians, *_ = drawn(rt, motion, CROP, rows)
    extents = rt.download(projector._extents)[: 6 * gaussians.stride].reshape(6, -1)
    return rows[:, extents[1, :COUNT] >= extents[0, :COUNT]][:, ::FEW_SEEN]


def splat_case(rt: Runtime, motion: str) -> Counts:
    """What an iteration does with a panel, on a crop of it."""
    rows = seen_by_crop(motion)
    projector, gaussians, cells, counts = drawn(rt, motion, CROP, rows)
    images = [rt.upload(pad_rows(np.random.default_rng(k).uniform(0, 1, (CROP, CROP)))) for k in range(2)]
    mask = rt.upload(pad_rows(np.ones((CROP, CROP))))
    loss, gradients = ImageLoss(rt, CROP, CROP, pitch_of(CROP), 0.2), rt.zeros((13, gaussians.stride))
    NOTED.append((START, 0))
    by_image = loss.evaluate(projector.forward(gaussians, cells), images[1], mask, CROP**2)
    projector.backward(gaussians, cells, by_image, gradients)
    return counts


def cloud_case(rt: Runtime) -> Counts:
    """What an iteration does without a panel, with few of the Gaussians: total variation, activations, Adam."""
    rows = cloud(COUNT, LINES, np.random.default_rng(0))[:, ::FEW]
    gaussians, grid = DeviceGaussians.upload(rt, rows), Grid.cube(LINES // 2, 2.0)
    shape, corner = (TV_EDGE,) * 3, ((LINES // 2 - TV_EDGE) // 2,) * 3
    crop, term = Voxeliser(rt, shape), TotalVariation(rt, shape, pitch_of(TV_EDGE))  # type: ignore[arg-type]
    activation, stride = Activation(1e-4, 1.0), gaussians.stride
    adam, raw = DeviceAdam(rt, activation), rt.upload(np.zeros((11, stride), np.float32))
    rt.write(raw, np.pad(activation.invert(rows), ((0, 0), (0, stride - gaussians.count)), constant_values=1.0))
    gradients, statistics, moments = rt.zeros((13, stride)), rt.zeros((2, stride)), rt.zeros((2, 11, stride))
    NOTED.append((START, 0))
    adam.activate(raw, gaussians.rows, gaussians.count, stride)
    by_volume = term.evaluate(crop.forward(gaussians, grid, corner))  # type: ignore[arg-type]
    crop.backward(gaussians, grid, by_volume, gradients, add=True, weight=0.01)
    weights = {"density_weight": 0.001, "shape_weight": 0.0, "shape_ratio": 10.0, "shape_floor": 0.004}
    adam.chain(raw, gaussians.rows, gradients, statistics, gaussians.count, stride, **weights)
    adam.step(raw, gradients, moments, stride, np.full(11, 0.01), 1)
    return {}


def splat_costs(motion: str) -> tuple[Costs, Facts]:
    """An iteration at full size; and how much there is of everything there."""
    launches, small = counted(f"splats {motion}")
    rows = cloud(COUNT, LINES, np.random.default_rng(0))
    large = drawn(Runtime(lanes=1, pixel_items=True), motion, LINES, rows)[-1]
    costs: Costs = {}
    for name, count, nbytes in launches:
        unit = UNIT.get(name, "pixels")
        grown = large[unit] / small[unit]
        costs[name] = count * grown, SPLAT_BYTES[name](large, motion) if name in SPLAT_BYTES else nbytes * grown
    for name, count, nbytes in counted("cloud")[0]:
        grown = 1 if name == "total_variation" else FEW
        other = f"{name} of the small volume" if name in costs else name
        costs[other] = count * grown, nbytes * grown
    return costs, {"large": large, "small": small}


def record_bytes(motion: str) -> int:
    return 4 * RECORD_FLOATS[motion == "exact"]


SPLAT_BYTES: dict[str, Callable[[Counts, str], float]] = {
    "splat_prepare": lambda n, motion: n["footprints"] * record_bytes(motion) + n["gaussian_cells"] + 68 * n["gaussians"],
    "splat_forward_pixels": lambda n, motion: (
        n["footprints"] * record_bytes(motion) + n["gaussian_cells"] + 4 * (n["entries"] + n["pixels"])
    ),
    "splat_backward_group": lambda n, motion: (
        n["footprints"] * (record_bytes(motion) + 64) + n["gaussian_cells"] + 4 * n["pixels"]
    ),
    "splat_chain": lambda n, motion: n["footprints"] * record_bytes(motion) + n["gaussian_cells"] + 96 * n["gaussians"],
    "bin_count_group": lambda n, motion: 24 * n["gaussians"] + 4 * n["counts"],
    "bin_within_group": lambda n, motion: 8 * n["counts"],
    "bin_starts_group": lambda n, motion: 8 * n["tiles"],
    "bin_fill_group": lambda n, motion: 24 * n["gaussians"] + 4 * (n["counts"] + n["entries"]),
}  # fmt: skip
"""Of arrays that have room for more than is touched: what is touched."""


# --- FISTA-TV ----------------------------------------------------------------------------------------------------


def fista_case(rt: Runtime, edge: int, iterations: int) -> Counts:
    pixels, protocol = 2 * edge, make_protocol("rapid")
    geometry = ConeGeometry(5.0, 7.0, (pixels, pixels), (4.0 / pixels,) * 2)
    frames = np.random.default_rng(0).uniform(0, 1, (FEW_VIEWS, pixels, pixels)).astype(np.float32)
    where = geometry, protocol.orbit(geometry), protocol.shutter(), protocol.frame_start_s()[:FEW_VIEWS]
    options = method_options("fista-tv", None, {"motion": "per-row", "iterations": iterations})
    reconstruct(Scan(frames, *where, Grid.cube(edge, 2.0)), RunPlan("fista-tv", options), rt)
    return {}


def iteration_of(edge: int) -> Costs:
    """The second iteration: what two have over one."""
    costs: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
    for iterations, sign in ((2, 1), (1, -1)):
        for name, count, nbytes in counted(f"fista {edge} {iterations}")[0]:
            costs[name][0] += sign * count
            costs[name][1] += sign * nbytes
    return {name: (count, nbytes) for name, (count, nbytes) in costs.items() if count > 0}


def fista_costs() -> Costs:
    """Element-wise kernels and the adjoint grow with voxels and pixels, which grow alike; a ray with the volume's edge. How
    the adjoint's groups look for their cells grows with the lines of a frame as well, which is left out: at least so much.
    """
    part, grown = iteration_of(EDGE), (VOXELS / EDGE) ** 3
    costs = {name: (count * grown, nbytes * grown) for name, (count, nbytes) in part.items()}
    views, volume_bytes, frames_bytes = VIEWS / FEW_VIEWS, 4 * VOXELS**3, 4 * VIEWS * (2 * VOXELS) ** 2
    costs["rays_forward"] = costs["rays_forward"][0] * views, VIEWS * volume_bytes + frames_bytes
    costs["rays_adjoint"] = costs["rays_adjoint"][0] * views, 2 * volume_bytes + frames_bytes
    return costs


# --- all of it ---------------------------------------------------------------------------------------------------

CASES: dict[str, Callable[..., Counts]] = {"splats": splat_case, "cloud": cloud_case, "fista": fista_case}


def run_case(name: str, *words: str) -> int:
    """One case in this process, under Oclgrind; its launches and counts are the last line on standard error."""
    rt = Runtime("oclgrind", lanes=1, pixel_items=True)
    note_launches()
    counts = CASES[name](rt, *(int(word) if word.isdecimal() else word for word in words))
    print(json.dumps([NOTED, counts]), file=sys.stderr)
    return 0


def times_ms(costs: Costs) -> dict[str, dict[str, tuple[float, str]]]:
    """By device and kernel: milliseconds, and what bounds them."""
    found: dict[str, dict[str, tuple[float, str]]] = {}
    for device, (flops, bandwidth) in PEAKS.items():
        found[device] = {
            name: max((2e3 * count / flops, "instructions"), (1e3 * nbytes / bandwidth, "bytes"))
            for name, (count, nbytes) in costs.items()
        }
    return found


def table(title: str, costs: Costs) -> str:
    """Markdown: every kernel above a hundredth of the whole, the rest together, the sum."""
    by_device = times_ms(costs)
    totals = {device: sum(ms for ms, _ in found.values()) for device, found in by_device.items()}
    lines = [f"| {title} | 10⁶ instructions | MB | " + " | ".join(f"{d}: ms" for d in PEAKS) + " |", "|---" * 5 + "|"]
    rest = [0.0] * 4
    for name, (count, nbytes) in sorted(costs.items(), key=lambda item: -by_device["RTX 4090"][item[0]][0]):
        row = [count / 1e6, nbytes / 1e6, *(found[name][0] for found in by_device.values())]
        if row[2] < 0.01 * totals["RTX 4090"]:
            rest = [a + b for a, b in zip(rest, row, strict=True)]
            continue
        bounds = [found[name][1] for found in by_device.values()]
        cells = [f"{row[0]:.3g}", f"{row[1]:.3g}", *(f"{ms:.3g} ({by})" for ms, by in zip(row[2:], bounds, strict=True))]
        lines.append(f"| `{name}` | " + " | ".join(cells) + " |")
    lines.append("| others | " + " | ".join(f"{number:.3g}" for number in rest) + " |")
    lines.append("| all | | | " + " | ".join(f"**{total:.3g}**" for total in totals.values()) + " |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--table", type=Path, default=None, help="file for the tables")
    parser.add_argument("--case", default="", help="of Oclgrind's process")
    asked = parser.parse_args()
    if asked.case:
        return run_case(*asked.case.split())
    motions = MOTIONS[:1] if asked.quick else MOTIONS
    facts: Facts = {"peaks": PEAKS, "model": True}
    tables = []
    for motion in motions:
        costs, sizes = splat_costs(motion)
        facts[motion] = {"sizes": sizes, "costs": costs, "ms": times_ms(costs)}
        tables.append(table(f"iteration, {motion}", costs))
    if not asked.quick:
        costs = fista_costs()
        facts["fista-tv"] = {"costs": costs, "ms": times_ms(costs)}
        tables.append(table("FISTA-TV, an iteration", costs))
    finish(facts, asked.json)
    text = "\n".join(tables)
    print(text)
    if asked.table is not None:
        asked.table.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
