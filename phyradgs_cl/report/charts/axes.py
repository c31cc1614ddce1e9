"""The frame of a small chart in SVG: data to picture coordinates, ticks, labels."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.report.facts import number
from phyradgs_cl.report.markup import Markup, element, joined

WIDTH, HEIGHT = 440, 320
LEFT, RIGHT, TOP, BOTTOM = 62, 14, 34, 50  # margins
Points = Iterable[tuple[float, float]]


@dataclass(frozen=True)
class Axes:
    """A chart area from ``x`` (first, last) and ``y`` (lowest, highest) of the data; ``log``, ``log_x``: logarithmic."""

    x: tuple[float, float]
    y: tuple[float, float]
    log: bool = False
    log_x: bool = False

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Picture coordinates of a point."""
        across, up = _share(x, self.x, self.log_x), _share(y, self.y, self.log)
        return LEFT + across * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - up * (HEIGHT - TOP - BOTTOM)

    def points(self, points: Points) -> str:
        """Points as an SVG list."""
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in (self.at(*point) for point in points))

    def polygon(self, points: Points, class_: str) -> Markup:
        return element("polygon", points=self.points(points), class_=class_)

    def polyline(self, points: Points, class_: str) -> Markup:
        return element("polyline", points=self.points(points), class_=class_)

    def dot(self, x: float, y: float, class_: str, radius: float = 2.2) -> Markup:
        cx, cy = self.at(x, y)
        return element("circle", cx=cx, cy=cy, r=radius, class_=class_)

    def text(
        self, x: float, y: float, words: str, *, shift: tuple[float, float] = (0, 0), class_: str = ""
    ) -> Markup:
        px, py = self.at(x, y)
        return text(px + shift[0], py + shift[1], words, class_=class_)

    def frame(self, x_label: str, y_label: str) -> Markup:
        """Axes with ticks, light lines across, and labels."""
        x_ticks = decades(*self.x) if self.log_x else ticks(*self.x)
        y_ticks = decades(*self.y) if self.log else ticks(*self.y)
        return joined(
            *(self._x_tick(t) for t in x_ticks),
            *(self._y_tick(t) for t in y_ticks),
            self.polyline([(self.x[0], self.y[1]), (self.x[0], self.y[0]), (self.x[1], self.y[0])], "axis"),
            text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 10, x_label),
            text(16, (TOP + HEIGHT - BOTTOM) / 2, y_label, turned=True),
        )

    def _x_tick(self, at: float) -> Markup:
        return self.text(at, self.y[0], number(at), shift=(0, 18), class_="tick")

    def _y_tick(self, at: float) -> Markup:
        line = self.polyline([(self.x[0], at), (self.x[1], at)], "grid")
        return joined(line, self.text(self.x[0], at, number(at), shift=(-7, 4), class_="tick end"))


def _share(value: float, ends: tuple[float, float], log: bool) -> float:
    """How far ``value`` is from the first of two ends to the other."""
    low, high, at = np.log10([*ends, value]).tolist() if log else (*ends, value)
    return float((at - low) / ((high - low) or 1.0))


def text(x: float, y: float, words: str, *, class_: str = "", turned: bool = False) -> Markup:
    """A label, centred at a point of the picture unless its class says otherwise; ``turned`` reads upwards."""
    turn = f"rotate(-90 {x:.1f} {y:.1f})" if turned else None
    return element("text", words, x=x, y=y, class_=class_ or None, transform=turn)


def svg(content: Markup, title: str, description: str, size: tuple[float, float] = (WIDTH, HEIGHT)) -> Markup:
    """A drawing with its name and, for those who do not see it, what it shows."""
    box = f"0 0 {size[0]:g} {size[1]:g}"
    what = f"{title}. {description}"
    return element("svg", content, viewBox=box, role="img", aria_label=what, class_="drawing")


def ticks(low: float, high: float, about: int = 5) -> Sequence[float]:
    """Round numbers from ``low`` to ``high``, some ``about`` of them."""
    span = high - low
    if not span > 0:
        return [low]
    rough = span / about
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * min((1, 2, 5, 10), key=lambda factor: abs(factor * power - rough))
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    return [float(np.round(k * step, 12)) + 0.0 for k in np.arange(first, last + 1)]


def decades(low: float, high: float) -> Sequence[float]:
    """1, 2 and 5 times powers of ten between two positive numbers; powers alone where those are many."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    factors = (1,) if len(powers) > 4 else (1, 2, 5)
    return [f * 10.0**p for p in powers for f in factors if low * 0.999 <= f * 10.0**p <= high * 1.001]
