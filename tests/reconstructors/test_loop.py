"""The loop around stepwise methods: what it records and reports, why it ends, what it goes on from."""

import time
from collections.abc import Callable

import numpy as np
import pytest

from phyradgs_cl.errors import NumericalError
from phyradgs_cl.fields import Grid
from phyradgs_cl.parallel import Communicator
from phyradgs_cl.reconstructors import Progress
from phyradgs_cl.reconstructors.loop import Loop


class Halving:
    """Three iterations per step; the loss halves with each, and 1/256 is enough."""

    quantity, remedy, iterations = "loss", "lower the rate", 10

    def __init__(self) -> None:
        self.iteration, self.loss = 0, 1.0

    @property
    def finished(self) -> str | None:
        return "small enough" if self.loss <= 1 / 256 else None

    def step(self) -> None:
        now = min(self.iteration + 3, self.iterations)
        self.iteration, self.loss = now, self.loss / 2 ** (now - self.iteration)

    def measures(self) -> dict[str, float]:
        return {"loss": self.loss}

    def present_volume(self) -> tuple[np.ndarray, Grid]:
        return np.full((1, 1, 1), self.loss, np.float32), Grid.cube(1, 1.0)


def loop_of(report: Callable[[Progress], None], every: int = 1, record_every: int = 1) -> Loop:
    return Loop(Halving(), Communicator(), report, time.perf_counter(), record_every, every)


def iterations_of(loop: Loop) -> list[float]:
    return [line["iteration"] for line in loop.record]


def test_lines_and_reports_come_when_their_number_is_reached() -> None:
    seen: list[tuple[int, float]] = []
    loop = loop_of(lambda p: seen.append((p.iteration, float(p.volume()[0].max()))), every=5)
    loop.run(None)
    assert iterations_of(loop) == [3, 6, 9]
    assert seen == [(6, 2.0**-6)]
    assert (loop.stopped_by, loop.interrupted_at, loop.state_if_interrupted()) == ("small enough", None, None)


def test_a_loss_that_is_no_number_is_named() -> None:
    loop = loop_of(lambda progress: None)
    loop.method.loss = np.nan
    with pytest.raises(NumericalError, match="loss: found nan at iteration 3; .*lower the rate"):
        loop.run(None)
