"""The whole scan under another statement: sizes or distances in another unit, frames that are mirrored or transposed."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.field_of_view import default_grid
from phyradgs_cl.check.coarse import coarse_grid
from phyradgs_cl.check.finding import FEWEST_COLUMNS
from phyradgs_cl.check.variants import mirrored, path_of, resized, transposed
from phyradgs_cl.fields import Grid

FACTORS = (10.0, 0.1, 1e3, 1e-3)
_UNITS = {10.0: " (in cm, read as mm?)", 1e3: " (in m, read as mm?)", 1e-3: " (in µm, read as mm?)"}
_FANS = (0.02, 3.0)  # the panel's width over its distance from the source, of scans that there are
_NEAR = 3.0  # times as large as what the panel sees: from there a stated grid does not belong to the hypothesis
_APART = 1.0  # coarse pixels
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
        sizes, distances = (f"{what} {k:g} times as large" for what, k in (("pixel sizes", factor), ("distances", 1 / factor)))
        sizes, distances = sizes + _UNITS.get(factor, ""), distances + _UNITS.get(round(1 / factor, 6), "")
        correct_sizes, correct_distances = "correct x_pixel_size and y_pixel_size", "correct the distances"
        moved_px = np.abs(np.array(geometry.detector_offset_mm) / geometry.pixel_size_mm) * abs(1 - 1 / factor)
        if (moved_px < _APART * np.array(path_of(scan).blocks)).all():
            text = f"frames fit with {sizes}, or with {distances}: they do not tell which"
            yield Cause(text, f"{correct_sizes}, or {correct_distances}", partial(_under, scan, stated, factor, True), factor)
            continue
        if 1 - (1 - stated_redundancy(stated)) / factor >= REDUNDANT:
            text = f"frames fit with {sizes}, detector_offset as stated"
            yield Cause(text, correct_sizes, partial(_under, scan, stated, factor, False), factor)
        if stated_redundancy(stated) >= REDUNDANT:
            text = f"frames fit with {distances}, or with pixel sizes and detector_offset {factor:g} times as large"
            advice = f"{correct_distances}, or pixel sizes and detector_offset"
            yield Cause(text, advice, partial(_under, scan, stated, factor, True), factor)


def _images(scan: Scan, stated: Scan) -> Iterator[Cause]:
    advice = "turn the frames as the panel saw them, import them again and check again"
    offset_v_mm, offset_u_mm = stated.geometry.detector_offset_mm
    if offset_u_mm or stated.shutter.axis == "columns":
        text = "frames fit if they are mirrored in u (or turned the other way, with detector_offset and readout the other way)"
        yield Cause(text, advice, partial(mirrored, scan, "u"))
    if offset_v_mm:
        text = "frames fit if they are mirrored in v (or with detector_offset along v and readout the other way)"
        yield Cause(text, advice, partial(mirrored, scan, "v"))
    if scan.geometry.detector_shape[0] >= FEWEST_COLUMNS:
        text = "frames fit if they are transposed, rows and columns exchanged (or turned by 90°"
        yield Cause(f"{text})", advice, partial(transposed, scan, False))
        yield Cause(f"{text}: more likely)", advice, partial(transposed, scan, True))


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
