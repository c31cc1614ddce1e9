"""The scan under another statement: other sizes, distances, angles or orders, frames that are mirrored or transposed."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.geometry import default_grid
from phyradgs_cl.check.coarse import coarse_grid
from phyradgs_cl.check.finding import FEWEST_COLUMNS, MIRROR_U, MIRROR_V, PIXEL_SIZES
from phyradgs_cl.check.questions.timing import start_azimuths_rad, wrapped
from phyradgs_cl.check.variants import (
    Path,
    mirrored,
    path_of,
    resized,
    stretched,
    transposed,
    turned,
    with_path,
)
from phyradgs_cl.fields import Grid

FACTORS = (10.0, 0.1, 1e3, 1e-3)
_UNITS = {10.0: " (in cm, read as mm?)", 1e3: " (in m, read as mm?)", 1e-3: " (in µm, read as mm?)"}
_FANS = (0.02, 3.0)  # the panel's width over its distance from the source, of scans that there are
_NEAR = 3.0  # times as large as what the panel sees: from there a stated grid does not belong to the hypothesis
_APART = 1.0  # coarse pixels
_TRANSPOSED = (
    "transpose the frames (numpy: .T of each) or turn them by 90° (numpy: rot90) and import them again: the two differ by "
    "a mirror that no frame shows, so that one gives a mirror image; only a feature whose side is known tells which"
)
REDUNDANT = 0.5  # share of columns that see a ray twice in a full turn: frames that see it once fit with anything


@dataclass(frozen=True, eq=False)
class Cause:
    """Another statement about the scan: what it is, what to do, and the scan under it. Of causes with the same ``factor`` of
    sizes only the shift of the panel tells them apart."""

    text: str
    advice: str
    scan: Callable[[], Scan]
    factor: float = 1.0


def stated_redundancy(scan: Scan) -> float:
    """The share of columns whose rays a full turn measures twice; below 0 the stated axis is beside the panel."""
    geometry = scan.geometry
    return 1 - 2 * abs(geometry.detector_offset_mm[1]) / (geometry.pixel_size_mm[1] * geometry.detector_shape[1])


def whole_scans(scan: Scan, stated: Scan) -> Iterator[Cause]:
    """What may be wrong with the coarse ``scan`` as a whole, which was made of the scan as ``stated``."""
    yield from _fans(scan, stated)
    yield from _images(scan, stated)


def _fans(scan: Scan, stated: Scan) -> Iterator[Cause]:
    geometry = stated.geometry
    fan = geometry.detector_shape[1] * geometry.pixel_size_mm[1] / geometry.source_to_detector_mm
    for factor in FACTORS:
        if not _FANS[0] < factor * fan < _FANS[1]:
            continue
        sizes, distances = _times("pixel sizes", factor), _times("distances", 1 / factor)
        correct_sizes, correct_distances = f"correct {PIXEL_SIZES}", "correct the distances"
        moved_px = np.abs(np.array(geometry.detector_offset_mm) / geometry.pixel_size_mm) * abs(1 - 1 / factor)
        if (moved_px < _APART * np.array(path_of(scan).blocks)).all():
            text = f"frames fit with {sizes}, or with {distances}: they do not tell which"
            advice = f"{correct_sizes}, or {correct_distances}"
            yield Cause(text, advice, partial(_under, scan, stated, factor, True), factor)
            continue
        if 1 - (1 - stated_redundancy(stated)) / factor >= REDUNDANT:
            text = f"frames fit with {sizes}, detector_offset as stated"
            yield Cause(text, correct_sizes, partial(_under, scan, stated, factor, False), factor)
        if stated_redundancy(stated) >= REDUNDANT:
            text = f"frames fit with {distances}, or with pixel sizes and detector_offset {factor:g} times as large"
            advice = f"{correct_distances}, or pixel sizes and detector_offset"
            yield Cause(text, advice, partial(_under, scan, stated, factor, True), factor)


def _times(what: str, factor: float) -> str:
    return f"{what} {factor:g} times as large{_UNITS.get(round(factor, 6), '')}"


def _images(scan: Scan, stated: Scan) -> Iterator[Cause]:
    advice = "import again with the other {}, and check again"
    offset_v_mm, offset_u_mm = stated.geometry.detector_offset_mm
    if offset_u_mm or stated.shutter.axis == "columns":
        text = "frames fit if they are mirrored in u (or with rotation, detector_offset and readout the other way)"
        yield Cause(text, advice.format(MIRROR_U), partial(mirrored, scan, "u"))
    if offset_v_mm:
        text = "frames fit if they are mirrored in v (or with detector_offset along v and readout the other way)"
        yield Cause(text, advice.format(MIRROR_V), partial(mirrored, scan, "v"))
    if scan.geometry.detector_shape[0] >= FEWEST_COLUMNS:
        text = "frames fit if they are transposed, rows and columns exchanged (or turned by 90°"
        yield Cause(f"{text})", _TRANSPOSED, partial(transposed, scan, False))
        yield Cause(f"{text}: more likely)", _TRANSPOSED, partial(transposed, scan, True))


def _under(scan: Scan, stated: Scan, factor: float, keeps_axis: bool) -> Scan:
    """The coarse scan with pixels ``factor`` times as large, and the grid that belongs to them."""
    v_mm, u_mm = stated.geometry.pixel_size_mm
    off_v_mm, off_u_mm = (offset * (factor if keeps_axis else 1) for offset in stated.geometry.detector_offset_mm)
    pixel_size_mm = (factor * v_mm, factor * u_mm)
    geometry = replace(stated.geometry, pixel_size_mm=pixel_size_mm, detector_offset_mm=(off_v_mm, off_u_mm))
    blocks = path_of(scan).blocks
    panel = replace(scan.geometry, pixel_size_mm=(blocks[0] * pixel_size_mm[0], blocks[1] * pixel_size_mm[1]))
    other = resized(scan, factor, keeps_axis)
    return replace(other, geometry=panel, grid=coarse_grid(_grid(stated, default_grid(geometry)), panel, 1.0))


def _grid(stated: Scan, seen: Grid) -> Grid:
    """The stated grid, or what the panel would see where that is another size or the grid was made of the wrong panel."""
    share = max(stated.grid.size_mm) / max(seen.size_mm)
    is_made = stated.grid == default_grid(stated.geometry)
    return seen if is_made or not 1 / _NEAR < share < _NEAR else stated.grid


def causes_of_frames(scan: Scan, shifted_scan: Scan, looks_closely: bool) -> Iterator[Cause]:
    """Other angles, sizes near the stated ones (of the scan with its panel shifted) and, looked at closely, other orders."""
    yield from _arcs(scan)
    yield from _sizes(shifted_scan)
    if looks_closely:
        yield from _orders(scan)
        yield from _missing(scan)


def _orders(scan: Scan) -> Iterator[Cause]:
    path = path_of(scan)
    numbers = np.arange(scan.frames) if path.frames is None else path.frames
    count = int(numbers[-1]) + 1
    starts = np.interp(np.arange(count), numbers, scan.frame_start_s)
    for first in (0, 1):
        lexical = np.array(sorted(range(first, count + first), key=str)) - first
        if (lexical == np.arange(count)).all():
            continue
        true = lexical[numbers]

        def ordered(true: np.ndarray = true) -> Scan:
            return replace(with_path(scan, frames=true), frame_start_s=starts[true])

        text = "frames fit in another order: that of names without leading zeros (1, 10, 11, ... 2)"
        yield Cause(text, "sort the frames by number, not by name, and import them again", ordered)


def _azimuths(scan: Scan) -> np.ndarray:
    """Angle of each frame's start from the first one's (F,), as the trajectory counts it where it does."""
    base = path_of(scan).base
    if hasattr(base, "angle_rad"):
        path = path_of(scan)
        numbers = np.arange(scan.frames) if path.frames is None else path.frames
        at = [float(base.angle_rad(int(n), np.array([scan.frame_start_s[f]]))[0]) for f, n in enumerate(numbers)]
        return np.array(at) - at[0]
    angles = start_azimuths_rad(scan)
    return np.unwrap(angles) - angles[:1]


def _arcs(scan: Scan) -> Iterator[Cause]:
    from_first = _azimuths(scan)
    path = path_of(scan)
    sense = -1.0 if path.is_reversed else 1.0
    total_deg = float(np.rad2deg(abs(from_first[-1])))
    radian = float(np.degrees(1.0))
    named = {
        radian: "angles in radians were taken for degrees",
        1 / radian: "angles in degrees were taken for radians",
        0.5: "the step of the angles is half of what is stated",
        2.0: "the step of the angles is twice what is stated",
    }
    for percent in (-5, -4, -3, -2, -1, 1, 2, 3, 4, 5):
        than_stated = f"{abs(percent)} % {'smaller' if percent < 0 else 'larger'} than stated"
        named[1 + percent / 100] = f"the step of the angles is about {than_stated}"
    for factor, text in named.items():
        span = f"the frames span {factor * total_deg:.4g}°, not {total_deg:.4g}°"
        advice = f"{span}: correct rotation_angle, its unit or its step"
        turn = sense * (factor - 1) * from_first
        yield Cause(text, advice, partial(turned, scan, turn, factor))


def _sizes(scan: Scan) -> Iterator[Cause]:
    v, u = scan.geometry.pixel_size_mm
    if abs(v / u - 1) > 0.02:
        text, advice = "pixel sizes fit if v and u are exchanged", f"exchange {PIXEL_SIZES}"
        yield Cause(text, advice, partial(stretched, scan, u / v, v / u))
    for factor in (0.5, 0.8, 0.9, 1.1, 1.25, 2.0):
        text = f"pixels over the distance of the panel fit if they are {factor:g} times as large"
        advice = f"correct {PIXEL_SIZES} (binning? unit?) or distances (unit? source to panel?)"
        yield Cause(text, advice, partial(nearly_sized, scan, factor))


def nearly_sized(scan: Scan, factor: float) -> Scan:
    """Pixels ``factor`` times as large with the axis at its column, and a grid that grows as it does for ``stretched``."""
    return replace(resized(scan, factor, keeps_axis=True), grid=stretched(scan, factor, factor).grid)


def _missing(scan: Scan) -> Iterator[Cause]:
    """Frames that are missing, or there twice, with later ones moved up or back by a step."""
    steps = wrapped(np.diff(_azimuths(scan)))
    step = float(np.median(steps)) * (-1.0 if path_of(scan).is_reversed else 1.0)
    for at in np.unique(np.linspace(1, scan.frames - 1, 15).round().astype(int)):
        later = (np.arange(scan.frames) >= at) * step
        number = frame_number(scan, int(at))
        text = f"a frame is missing near frame {number} (from 0): later ones fit one step further on"
        advice = "find the missing frame, or shift the angles behind it by a step"
        yield Cause(text, advice, partial(turned, scan, later))
        text = f"a frame is there twice near frame {number} (from 0): later ones fit one step before"
        advice = "take the frame out, so that later ones get their own angles"
        yield Cause(text, advice, partial(turned, scan, -later))


def frame_number(scan: Scan, frame: int) -> int:
    """A frame's number in the file, from 0."""
    path = scan.trajectory
    return int(path.frames[frame]) if isinstance(path, Path) and path.frames is not None else int(frame)
