"""Random geometries, shutters, motions and clouds for the laws, and how many of them."""

import os

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, ParallelGeometry, Shutter
from phyradgs_cl.acquisition.cells import micro_view_cells, per_line_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid

STRESSED = int(os.environ.get("STRESS", "1")) > 1
many = settings(
    max_examples=1000 if STRESSED else 20, deadline=None, derandomize=True, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
"""Cases of a law: a thousand in `make stress`."""


@st.composite
def tables(draw: st.DrawFn) -> tuple[tuple[int, int], list[TimeCells]]:
    """A detector's shape and the time cells of two frames of a random scanner round a volume of side 2."""
    shape = (draw(st.integers(1, 9)), draw(st.integers(1, 20)))
    distance = draw(st.floats(2.5, 20.0))
    magnification = draw(st.floats(1.05, 3.0))
    side = 3.0 * magnification
    offset = (draw(st.floats(-0.4, 0.4)), draw(st.floats(-0.4, 0.4)))
    pitch = (side / shape[0] * draw(st.floats(0.5, 1.5)), side / shape[1] * draw(st.floats(0.5, 1.5)))
    cone = ConeGeometry(distance, distance * magnification, shape, pitch, offset)
    geometry = ParallelGeometry(shape, pitch, offset) if draw(st.booleans()) else cone
    orbit = CircularOrbit(geometry, ConstantSpeed(draw(st.floats(-7, 7)), draw(st.floats(-2, 2))))
    axis, direction = draw(st.sampled_from(["rows", "columns"])), draw(st.sampled_from([1, -1]))
    shutter = Shutter(draw(st.floats(0.01, 1.0)), draw(st.floats(0.0, 1.0)), axis, direction)
    motion = draw(st.sampled_from(["static", "micro-views", "per-row"]))
    found = []
    for frame in range(2):
        where = (orbit, shutter, frame, 1.7 * frame, shutter.lines(shape))
        if motion == "static":
            found.append(static_cells(*where))
        elif motion == "micro-views":
            found.append(micro_view_cells(*where, draw(st.integers(1, 4)), draw(st.integers(1, 3))))
        else:
            found.append(per_line_cells(*where, draw(st.integers(1, 3))))
    return shape, found


@st.composite
def grids(draw: st.DrawFn) -> Grid:
    """Up to some thousand voxels, about as large as a volume of side 2, anywhere near the axis."""
    shape = tuple(draw(st.integers(1, 14)) for _ in range(3))
    size = tuple(draw(st.floats(0.8, 2.2)) / n for n in shape)
    offset = tuple(draw(st.floats(-0.3, 0.3)) for _ in range(3))
    return Grid(shape, size, offset)  # type: ignore[arg-type]


seeds = st.integers(0, 2**32 - 1)
