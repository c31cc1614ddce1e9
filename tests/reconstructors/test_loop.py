"""The loop around stepwise methods: what it records and reports where a step is of several iterations."""

import time

import numpy as np

from phyradgs_cl.fields import Grid
from phyradgs_cl.parallel import Communicator
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


def test_lines_and_reports_come_when_their_number_is_reached() -> None:
    seen: list[tuple[int, float]] = []
    report = lambda p: seen.append((p.iteration, float(p.volume()[0].max())))  # noqa: E731
    loop = Loop(Halving(), Communicator(), report, time.perf_counter(), 1, 5)
    loop.run(None)
    assert [line["iteration"] for line in loop.record] == [3, 6, 9]
    assert seen == [(6, 2.0**-6)]
    assert (loop.stopped_by, loop.interrupted_at, loop.state_if_interrupted()) == ("small enough", None, None)
