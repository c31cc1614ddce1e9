"""Makes the 3D picture of a report: 8-bit voxels in one PNG, the Gaussians' centres, and controls."""

import math

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.report.images import Window, base64_of, block_means, bytes_of, png_bytes
from phyradgs_cl.report.markup import Markup, element, joined, json_block, number
from phyradgs_cl.report.viewer import choice, decimals_of, slider

MOST_EDGE = 128  # larger volumes are averaged over blocks to at most this many voxels along each side
MOST_TEXT = 2_000_000  # limit of base64 characters for voxels and centres together, so that the page stays small
MOST_CENTRES = 20_000  # the centres of at most this many Gaussians are shown, evenly chosen
MOST_ZOOM = 8
_TURN_DEG, _TILT_DEG = 325, 20  # initial view, in which the edges marked x, y, z are in front and on the left
_PATIENCE_MS = 1500  # the picture at rest becomes finer until drawing takes this long
_HELP = (
    "Drag to turn; on a touch screen one finger turns and two fingers tilt and zoom. Keys in the picture: arrows turn and "
    "tilt, + and − zoom, Home resets. Ctrl and the wheel zoom. Black and white are those of the slices."
)


def space(volume: NDArray[np.floating], grid: Grid, window: Window, gaussians: Gaussians | None) -> Markup | None:
    """Returns a 3D picture of a volume (nz, ny, nx) with its controls and the script's data; None for a volume one voxel
    thick. window: the slices' grey values. gaussians: in mm, or None."""
    if not has_depth(volume):
        return None
    cloud = None if gaussians is None or not gaussians.count else gaussians
    centres = None if cloud is None else _centres(cloud, grid)
    room = MOST_TEXT - sum(len(str(text)) for text in (centres or {}).values())
    means = block_means(volume, MOST_EDGE)
    steps = bytes_of(means, window.least, window.most)
    atlas, columns = _atlas_within(steps, room)
    size = " × ".join(map(str, volume.shape))
    reduced = "" if means.shape == volume.shape else f", means over blocks: {' × '.join(map(str, means.shape))}"
    span = (window.most - window.least) or 1.0
    data = {
        "counts": steps.shape[::-1], "size_mm": grid.size_mm[::-1], "atlas": atlas, "columns": columns,
        "least": window.least, "most": window.most, "decimals": decimals_of((window.most - window.least) / 255),
        "ends": [255 * (value - window.least) / span for value in (window.low, window.high)],
        "words": f"{size} voxels (z, y, x){reduced}", "centres": centres,
    }  # fmt: skip
    canvas = element(
        "canvas", id="space", tabindex=0, role="img", aria_label="The volume in 3D", aria_describedby="space-help",
        data_patience=_PATIENCE_MS,
    )
    letters = (element("b", letter, id=f"space-{letter}", aria_hidden="true") for letter in "xyz")
    return joined(
        element("div", *_controls(_between(steps), cloud), class_="tools"),
        element("div", canvas, *letters, element("span", class_="bar", id="space-bar"), class_="stage"),
        element("p", element("output", id="space-reading"), class_="note"),
        element("p", _HELP, class_="note help", id="space-help"), json_block("volume-data", data),
    )


def has_depth(volume: NDArray[np.floating]) -> bool:
    """Returns whether every side has at least two voxels; a flat volume cannot be shown in 3D."""
    return min(volume.shape) >= 2


def _controls(threshold: int, cloud: Gaussians | None) -> list[Markup]:
    controls = [
        choice("space-kind", "space", {"maximum": "Maximum", "surface": "Surface"}),
        slider("threshold", "Threshold", 1, 255, threshold, ""),
        slider("turn", "Turn", 0, 360, _TURN_DEG, f"{_TURN_DEG}°"),
        slider("tilt", "Tilt", -90, 90, _TILT_DEG, f"{_TILT_DEG}°"),
        slider("space-zoom", "Zoom", 1, MOST_ZOOM, 1, "1×", 0.1),
    ]
    if cloud is not None:
        some = f" ({number(MOST_CENTRES)} of {cloud.count})" if cloud.count > MOST_CENTRES else ""
        box = element("input", type="checkbox", id="centres")
        controls.append(element("label", box, f"Gaussians' centres{some}", class_="tick"))
    return [*controls, element("button", "Reset", type="button", id="space-reset")]


def _centres(cloud: Gaussians, grid: Grid) -> dict[str, str]:
    """Returns, in base64, evenly chosen Gaussians' centres inside the grid's box and their densities: x, y, z as 16-bit
    fractions of the box's sides, densities in 8 bits."""
    some = np.unique(np.linspace(0, cloud.count - 1, min(cloud.count, MOST_CENTRES)).round().astype(int))
    low_mm, size_mm = (np.array(three[::-1]) for three in (np.array(grid.box_mm)[:, 0], grid.size_mm))
    share = (cloud.mean[some] - low_mm) / size_mm
    is_inside = ((share >= 0) & (share <= 1)).all(axis=1)
    density = cloud.density[some][is_inside]
    highest = float(np.percentile(density, 99)) if density.size else 1.0
    places = np.rint(share[is_inside] * 65535).astype("<u2")
    return {"places": base64_of(places.tobytes()), "densities": base64_of(bytes_of(density, 0.0, highest).tobytes())}


def _atlas_within(steps: NDArray[np.uint8], most_text: int) -> tuple[str, int]:
    """Returns the slices of grey levels (nz, ny, nx) as one PNG in base64, and how many are side by side in it.

    Noise compresses badly, so the levels' lowest bits are dropped until the text has at most ``most_text`` characters."""
    nz, ny, nx = steps.shape
    columns = max(1, min(nz, round(math.sqrt(nz * ny / nx))))
    rows = math.ceil(nz / columns)
    sheet = np.zeros((rows * columns, ny, nx), np.uint8)
    for lost_bits in range(8):
        half = (1 << lost_bits) >> 1
        sheet[:nz] = (np.minimum(steps, 255 - half) + half) >> lost_bits << lost_bits
        picture = sheet.reshape(rows, columns, ny, nx).swapaxes(1, 2).reshape(rows * ny, columns * nx)
        text = base64_of(png_bytes(picture))
        if len(text) <= most_text:
            break
    return text, columns


def _between(steps: NDArray[np.uint8]) -> int:
    """Returns Otsu's threshold, from 1 to 255: it maximises the variance between the two classes of grey levels (IEEE
    Transactions on Systems, Man, and Cybernetics 9 (1979) 62)."""
    counts = np.bincount(steps.ravel(), minlength=256).astype(np.float64)
    below, sums = np.cumsum(counts), np.cumsum(counts * np.arange(256))
    above = below[-1] - below
    with np.errstate(all="ignore"):
        variance = below * above * (sums / below - (sums[-1] - sums) / above) ** 2
    variance = np.nan_to_num(variance)
    best = np.flatnonzero(variance >= variance.max() * (1 - 1e-9))  # several levels may be equally good: their mean is taken
    return int(np.clip(round(best.mean()) + 1, 1, 255))
