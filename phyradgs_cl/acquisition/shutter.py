"""The shutter: the times at which each detector line opens and closes."""

from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition.readout import FIRST_LINES, Readout
from phyradgs_cl.errors import InputError

AXES = ("rows", "columns")
_STEPS = 1000  # least (exposure) / (float64 spacing at the scan's latest time), to resolve a thousandth of the exposure
_DARK = 1e-9  # a line that is lit for at most this fraction of the longest-lit line's time counts as dark


@dataclass(frozen=True)
class Shutter:
    """Exposure and readout of one frame, in s (paper, section 2.1).

    Line r of H, in the order of reading, opens ``r/(H−1)·readout_s`` after the frame's start and stays open for
    ``exposure_s``. A readout of 0 is a global shutter. ``axis``: "rows" or "columns", whichever the panel reads one after
    the other. ``direction``: +1 reads index 0 first, −1 the last index. ``pulse_s`` (start, length): when the beam is on,
    after the frame's start; None means always. Raises InputError for times below 0, other axes or directions, and a pulse
    that misses the frame."""

    exposure_s: float
    readout_s: float = 0.0
    axis: str = "rows"
    direction: int = 1
    pulse_s: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        checks.at_least("exposure_s", self.exposure_s, 0)
        checks.at_least("readout_s", self.readout_s, 0)
        if self.axis not in AXES:
            raise InputError("readout axis", repr(self.axis), "'rows' or 'columns'")
        if self.direction not in (1, -1):
            expected = "1 (index 0 first) or -1 (index 0 last)"
            raise InputError("readout direction", checks.short_repr(self.direction), expected)
        if self.pulse_s is not None:
            self._check_pulse(*checks.numbers("pulse_s", self.pulse_s, (2,)).tolist())

    def _check_pulse(self, start_s: float, length_s: float) -> None:
        if length_s <= 0:
            found = f"start {start_s} s, length {length_s} s"
            raise InputError("pulse_s", found, "a finite start and a length above 0 s")
        if start_s >= self.span_s or start_s + length_s <= 0:
            found = f"{start_s:g} to {start_s + length_s:g} s"
            expected = f"a pulse that meets the frame's window, 0 to {self.span_s:g} s"
            raise InputError("pulse_s", found, expected, "correct the pulse, or leave it out")

    def check_resolved(self, frame_start_s: np.ndarray, subject: str = "exposure_s") -> None:
        """Raises InputError if 0 < exposure < 1000 times the float64 spacing at the scan's latest time.

        frame_start_s (F,): when frames open, in s. subject: what the message names."""
        latest_s = float(np.max(np.abs(frame_start_s), initial=0.0)) + self.span_s
        shortest_s = _STEPS * float(np.spacing(latest_s))
        if 0 < self.exposure_s < shortest_s:
            expected = f"0, or at least the {shortest_s:.2g} s that times of up to {latest_s:.3g} s can tell apart"
            raise InputError(subject, f"{self.exposure_s:.6g} s", expected, "correct the value or its unit")

    @property
    def readout(self) -> Readout:
        """The converter of frames and poses to the order (lines, width) in which the panel is read, and back."""
        return Readout(self.axis)

    @property
    def first(self) -> str:
        """The panel's side that is read first, seen from the source: "top", "bottom", "left" or "right"."""
        return next(side for side, order in FIRST_LINES.items() if order == (self.axis, self.direction))

    @property
    def span_s(self) -> float:
        """The time in s from the first line's opening to the last line's closing."""
        return self.exposure_s + self.readout_s

    @property
    def lit_span_s(self) -> tuple[float, float]:
        """When the frame's first and last light falls on the panel, in s after the frame's start."""
        first_s, last_s = self.in_pulse(np.array([0.0, self.span_s]))
        return float(first_s), float(last_s)

    @property
    def middle_s(self) -> float:
        """The middle between a frame's first and last light, in s after its start: the best time for a single pose."""
        first_s, last_s = self.lit_span_s
        return first_s + (last_s - first_s) / 2

    def in_pulse(self, time_s: np.ndarray) -> np.ndarray:
        """Moves times (...) after the frame's start to the nearest moment at which the beam is on.

        The two ends of a window are thus cut to the pulse. They become equal if the pulse misses the window."""
        if self.pulse_s is None:
            return time_s
        start_s, length_s = self.pulse_s
        return time_s.clip(start_s, start_s + length_s)

    def lines(self, detector_shape: tuple[int, int]) -> int:
        """Returns how many lines a panel (rows, columns) reads one after the other: its rows, or its columns."""
        return self.readout.shape(detector_shape)[0]

    def of_lines(self, lines: int, first: int, stop: int, block: int = 1) -> tuple["Shutter", float]:
        """Returns the shutter of only the lines [first, stop) of a panel's ``lines``, averaged over blocks of ``block``
        lines, and how much later than the frame its first block opens, in s: at the mean of its lines' opening times."""
        line_s = self.readout_s / max(lines - 1, 1)
        later_s = ((first if self.direction > 0 else lines - stop) + (block - 1) / 2) * line_s
        pulse_s = self.pulse_s and (self.pulse_s[0] - later_s, self.pulse_s[1])
        return replace(self, readout_s=(stop - first - block) * line_s, pulse_s=pulse_s), later_s

    def delay_s(self, lines: int) -> np.ndarray:
        """Returns when each line opens, (lines,) in s after the frame's start."""
        order = np.arange(lines) if self.direction > 0 else np.arange(lines)[::-1]
        return order / max(lines - 1, 1) * self.readout_s

    def line_windows_s(self, lines: int) -> np.ndarray:
        """Returns when each line's light begins and ends, (lines, 2) in s after the frame's start. Without a pulse these are
        the line's opening and closing. A line that the pulse misses has two equal times."""
        delay = self.delay_s(lines)
        return self.in_pulse(np.stack([delay, delay + self.exposure_s], -1))

    def lit_share(self, lines: int) -> np.ndarray:
        """Returns how long each line receives light, (lines,) as a fraction of the longest time; all 1 without a pulse.
        Raises InputError if no line receives light."""
        if self.pulse_s is None:
            return np.ones(lines)
        seen_s = np.diff(self.line_windows_s(lines))[:, 0]
        longest_s = seen_s.max()
        if longest_s <= 0:
            found = f"{self.pulse_s[0]:g} to {sum(self.pulse_s):g} s, while no line is open"
            raise InputError("pulse_s", found, "a pulse that meets the window of a line", "correct the pulse")
        return np.where(seen_s > _DARK * longest_s, seen_s / longest_s, 0.0)

    def strip_ranges(self, lines: int, strips: int) -> list[tuple[int, int]]:
        """Divides lines into ``strips`` that differ by at most one line, and returns the lines [start, stop) of each, in
        reading order. If there are more strips than lines, some have no line."""
        edges = [checks.ceil_div(strip * lines, strips) for strip in range(strips + 1)]
        ranges = list(zip(edges[:-1], edges[1:], strict=True))
        if self.direction < 0:
            ranges = [(lines - stop, lines - start) for start, stop in ranges]
        return ranges
