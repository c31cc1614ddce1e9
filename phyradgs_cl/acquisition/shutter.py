"""The shutter: when each detector line opens and closes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.errors import InputError

AXES = ("rows", "columns")


@dataclass(frozen=True)
class Shutter:
    """Exposure and readout of one frame (paper, section 2.1).

    Line r of H opens ``r/(H−1)·readout_s`` after the frame's start and stays open for ``exposure_s``.
    ``axis`` says what is read out at one time; ``direction`` +1 reads index 0 first, −1 last. A readout of
    zero is a global shutter.
    """

    exposure_s: float
    readout_s: float = 0.0
    axis: str = "rows"
    direction: int = 1

    def __post_init__(self) -> None:
        if not (np.isfinite(self.exposure_s) and self.exposure_s >= 0):
            raise InputError("exposure_s", str(self.exposure_s), "a time of at least 0 s")
        if not (np.isfinite(self.readout_s) and self.readout_s >= 0):
            raise InputError("readout_s", str(self.readout_s), "a time of at least 0 s")
        if self.axis not in AXES:
            raise InputError("readout axis", repr(self.axis), "'rows' or 'columns'")
        if self.direction not in (1, -1):
            raise InputError(
                "readout direction", str(self.direction), "1 (index 0 first) or -1 (index 0 last)"
            )

    @property
    def span_s(self) -> float:
        """From the first line's opening to the last line's closing."""
        return self.exposure_s + self.readout_s

    def lines(self, detector_shape: tuple[int, int]) -> int:
        """How many lines a (rows, columns) detector has along the readout axis."""
        return detector_shape[0] if self.axis == "rows" else detector_shape[1]

    def delay_s(self, lines: int) -> np.ndarray:
        """Opening delay τ (lines,) of every line index, in seconds after the frame's start."""
        order = np.arange(lines) if self.direction > 0 else np.arange(lines)[::-1]
        return order / max(lines - 1, 1) * self.readout_s

    def line_windows_s(self, lines: int) -> np.ndarray:
        """(lines, 2): when every line index opens and closes, in seconds after the frame's start."""
        delay = self.delay_s(lines)
        return np.stack([delay, delay + self.exposure_s], -1)

    def strip_ranges(self, lines: int, strips: int) -> list[tuple[int, int]]:
        """Line ranges [start, stop) of the strips, in the order in which they are read; may be empty.

        Line r (in reading order) belongs to strip floor(r·M/H).
        """
        edges = [-(-strip * lines // strips) for strip in range(strips + 1)]
        ranges = list(zip(edges[:-1], edges[1:], strict=True))
        if self.direction < 0:
            ranges = [(lines - stop, lines - start) for start, stop in ranges]
        return ranges
