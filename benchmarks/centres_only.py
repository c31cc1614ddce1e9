"""Measures the worth of the covariance: the errors of frames in which only the centres of Gaussians move.

    python benchmarks/centres_only.py docs/results/centres_only.jsonl

Errors are relative RMS of one frame of 128² pixels, by distance from the axis (half-sides of the box): the mean of eight
Gaussians in random orientations, against 60 times of every row's own. Long ones are 0.08 by 0.02 by 0.02, round ones
0.03."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from time_exact import reference_frame, relative

from phyradgs_cl.acquisition import ConeGeometry, TimeCells, make_protocol
from phyradgs_cl.acquisition.cells import (
    centre_cells,
    exact_cells,
    micro_view_cells,
    per_line_cells,
    static_cells,
)
from phyradgs_cl.operators import DeviceCells, SplatProjector
from phyradgs_cl.runtime import Runtime

PIXELS, COUNT, TIMES, FRAME = 128, 8, 60, 3
SCALES = {"round": (0.03, 0.03, 0.03), "long": (0.08, 0.02, 0.02)}
Line = dict[str, object]


def one_frame() -> tuple:
    """Returns trajectory, shutter, frame, start in seconds and lines."""
    protocol, side = make_protocol("rapid"), 4.0 / PIXELS
    geometry = ConeGeometry(5.0, 7.0, (PIXELS, PIXELS), (side, side))
    return protocol.orbit(geometry), protocol.shutter("rows"), FRAME, float(protocol.frame_start_s()[FRAME]), PIXELS


def models_of(where: tuple) -> dict[str, TimeCells]:
    return {
        "static": static_cells(*where), "centres": centre_cells(*where, 8, 5), "8x5": micro_view_cells(*where, 8, 5),
        "exact": exact_cells(*where, 4),
    }  # fmt: skip


def errors(rt: Runtime, where: tuple, rows: np.ndarray, expected: np.ndarray) -> dict[str, float]:
    projector = SplatProjector(rt, PIXELS, PIXELS)
    frames = {name: projector.project(rows, DeviceCells.upload(rt, table)) for name, table in models_of(where).items()}
    return {name: relative(frame, expected) for name, frame in frames.items()}


def gaussians(distance: float, scale: tuple[float, float, float], rng: np.random.Generator) -> np.ndarray:
    """Returns rows (11, COUNT) on a circle about the axis."""
    turn, angle = rng.normal(size=(4, COUNT)), rng.uniform(0, 2 * np.pi, COUNT)
    place = np.stack([distance * np.cos(angle), distance * np.sin(angle), rng.uniform(-0.5, 0.5, COUNT)])
    sizes = np.repeat(np.array(scale)[:, None], COUNT, axis=1)
    return np.concatenate([place, sizes, turn / np.linalg.norm(turn, axis=0), np.ones((1, COUNT))])


def by_distance(rt: Runtime) -> Iterator[Line]:
    where, rng = one_frame(), np.random.default_rng(0)
    reference = per_line_cells(*where, TIMES)
    for kind, scale in SCALES.items():
        for distance in (0.0, 0.2, 0.4, 0.6, 0.8):
            rows = gaussians(distance, scale, rng).T[..., None]
            each = [errors(rt, where, row, reference_frame(rt, row, reference, PIXELS)) for row in rows]
            means = {name: float(np.mean([found[name] for found in each])) for name in each[0]}
            yield {"gaussians": kind, "distance": distance, **means}


def main() -> None:
    rt = Runtime()
    Path(sys.argv[1]).write_text("".join(json.dumps(line) + "\n" for line in by_distance(rt)), encoding="utf-8")


if __name__ == "__main__":
    main()
