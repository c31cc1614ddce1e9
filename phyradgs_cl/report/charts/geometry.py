"""The scanner to scale: the orbit from above, and the fan from the side, from the poses themselves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.report.charts.axes import svg, text, ticks
from phyradgs_cl.report.facts import number
from phyradgs_cl.report.markup import Markup, element, joined

SIDE, MARGIN = 400, 34
_MOST_FRAMES = 180  # marks on the orbit
_ARC_SAMPLES = 24
Points = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """World coordinates (mm) of a plane to picture coordinates, one scale for both; the second axis points up."""

    low: Points
    high: Points

    @classmethod
    def around(cls, *points: Points) -> "Plan":
        every = np.concatenate([p.reshape(-1, 2) for p in points])
        return cls(every.min(axis=0), every.max(axis=0))

    @property
    def per_mm(self) -> float:
        return (SIDE - 2 * MARGIN) / (float(np.max(self.high - self.low)) or 1.0)

    @property
    def height(self) -> float:
        """Of the picture: as much as the plan needs, and room for labels."""
        return float((self.high - self.low)[1]) * self.per_mm + 2 * MARGIN + 16

    def at(self, points: Points) -> Points:
        centre = (self.low + self.high) / 2
        middle = np.array([SIDE / 2, (self.height - 16) / 2])
        return middle + (points - centre) * np.array([1, -1]) * self.per_mm

    def line(self, points: Points, class_: str, closed: bool = False) -> Markup:
        shown = " ".join(f"{x:.1f},{y:.1f}" for x, y in self.at(points))
        return element("polygon" if closed else "polyline", points=shown, class_=class_)

    def dot(self, point: Points, class_: str, radius: float) -> Markup:
        x, y = self.at(point)
        return element("circle", cx=float(x), cy=float(y), r=radius, class_=class_)

    def label(self, point: Points, words: str, shift: tuple[float, float], class_: str = "") -> Markup:
        x, y = self.at(point) + np.array(shift)
        half = 3.6 * len(words)  # of its width, about: labels stay in the picture
        return text(float(np.clip(x, half, SIDE - half)), float(y), words, class_=class_)

    def scale_bar(self) -> Markup:
        length_mm = ticks(0, 0.25 * SIDE / self.per_mm, 1)[-1] or 0.25 * SIDE / self.per_mm
        x, y, width = 10.0, self.height - 8, length_mm * self.per_mm
        bar = element(
            "polyline",
            points=f"{x},{y - 4:.1f} {x},{y:.1f} {x + width:.1f},{y:.1f} {x + width:.1f},{y - 4:.1f}",
            class_="axis",
        )
        return joined(bar, text(x + width / 2, y - 6, f"{number(length_mm)} mm", class_="tick"))


def orbit_drawing(scan: Scan) -> Markup:
    """From above: source positions of all frames, the first frame's arc, its fan of rays, panel and volume."""
    times_s = np.asarray(scan.frame_start_s) + scan.shutter.middle_s
    middles = np.stack([scan.trajectory.pose(f, times_s[f : f + 1])[0] for f in range(scan.frames)])
    arc = _first_arc(scan)
    panels = [panel_corners(pose, scan.geometry.detector_shape) for pose in arc[[0, -1]]]
    first, last = ([c[[0, 1]].mean(0), c[[2, 3]].mean(0)] for c in panels)
    ends, later = np.array(first)[:, :2], np.array(last)[:, :2]
    box = _box_corners(scan)[:4, :2]
    plan = Plan.around(middles[:, :2], arc[:, :2], ends, later, box)
    source = arc[0, :2]
    drawn = joined(
        plan.line(box, "volume", closed=True),
        *(plan.dot(pose[:2], "frame", 1.8) for pose in middles[:: -(-len(middles) // _MOST_FRAMES)]),
        plan.line(np.array([ends[0], source, ends[1]]), "rays"),
        plan.line(later, "panel faint") if scan.is_fly else None,
        plan.line(ends, "panel"),
        plan.line(arc[:, :2], "arc") if scan.is_fly else None,
        plan.dot(source, "source", 5),
        plan.dot(np.zeros(2), "pivot", 2.5),
        plan.label(source, "source", _clear_of(arc[:, :2])),
        plan.label(ends[ends[:, 1].argmax()], "panel", (0, -8)),
        plan.scale_bar(),
    )
    told = f"{scan.frames} source positions; the first frame's rays, panel and volume"
    return svg(drawn, "Geometry from above", told, (SIDE, plan.height))


def _clear_of(arc: Points) -> tuple[float, float]:
    """Where a label stands beside the first of points (T, 2) mm: away from the others."""
    way = arc[0] - arc[-1]
    length = float(np.linalg.norm(way))
    return (0.0, -12.0) if length == 0 else (float(20 * way[0] / length), float(5 - 20 * way[1] / length))


def side_drawing(scan: Scan) -> Markup:
    """From the side: the first frame's source, cone, panel and volume, in the plane of its axis and central ray."""
    pose = _first_arc(scan)[0]
    corners = panel_corners(pose, scan.geometry.detector_shape)
    across = (corners.mean(0) - pose[:3])[:2]
    across = across / (np.linalg.norm(across) or 1.0)

    def seen(points: Points) -> Points:
        return np.stack([points[..., :2] @ across, points[..., 2]], -1)

    source, low, high = seen(pose[:3]), seen(corners[[0, 2]].mean(0)), seen(corners[[1, 3]].mean(0))
    box = seen(_box_corners(scan))
    (left, bottom), (right, top) = box.min(0), box.max(0)
    outline = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    plan = Plan.around(source[None], low[None], high[None], outline)
    axis = np.array([[0, bottom - 0.1 * (top - bottom)], [0, top + 0.1 * (top - bottom)]])
    drawn = joined(
        plan.line(outline, "volume", closed=True),
        plan.line(axis, "turning"),
        plan.line(np.array([low, source, high]), "rays"),
        plan.line(np.array([low, high]), "panel"),
        plan.dot(source, "source", 5),
        plan.label(source, "source", (0, -12)),
        plan.label(high, "panel", (0, -8)),
        plan.label(axis[1], "axis", (0, -5)),
        plan.scale_bar(),
    )
    return svg(drawn, "Geometry from the side", "source, axis, volume and panel", (SIDE, plan.height))


def panel_corners(pose: Points, detector_shape: tuple[int, int]) -> Points:
    """Outer corners (4, 3) mm of the panel at a pose (12,): (low, left), (high, left), (low, right), (high, right)."""
    rows, columns = detector_shape
    u, v = np.array([-0.5, columns - 0.5]), np.array([-0.5, rows - 0.5])
    return np.array([pose[3:6] + a * pose[6:9] + b * pose[9:12] for a in u for b in v])


def _first_arc(scan: Scan) -> Points:
    """Poses (T, 12) of the first frame from first light to last."""
    first_s, last_s = scan.shutter.lit_span_s if scan.is_fly else (scan.shutter.middle_s,) * 2
    return scan.trajectory.pose(0, scan.frame_start_s[0] + np.linspace(first_s, last_s, _ARC_SAMPLES))


def _box_corners(scan: Scan) -> Points:
    """Corners (8, 3) x y z mm of the grid: the lower four around, then the upper four."""
    half, centre = np.array(scan.grid.size_mm[::-1]) / 2, np.array(scan.grid.offset_mm[::-1])
    around = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    return np.array([centre + half * (x, y, z) for z in (-1, 1) for x, y in around])
