"""Reads scanner descriptions: TOML files with geometry, volume and readout of the panel."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

from phyradgs_cl import checks
from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry
from phyradgs_cl.acquisition.geometry import Geometry, default_grid
from phyradgs_cl.acquisition.readout import readout_order
from phyradgs_cl.acquisition.scan import LARGEST_LAG
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.fields.volume import MOST_VOXELS
from phyradgs_cl.io.scan import BEAMS
from phyradgs_cl.io.tables import LARGEST_LENGTH, Fields, described, read_toml, refuse_unknown
from phyradgs_cl.text import suggest_name

TABLES: dict[str, tuple[str, ...]] = {
    "source": ("beam", "to_axis_mm", "to_detector_mm"),
    "detector": (
        *("rows", "columns", "pixel_size_v_mm", "pixel_size_u_mm", "offset_v_mm", "offset_u_mm"), "lag"
    ),
    "beam": ("pulse_start", "pulse_length"),
    "volume": ("shape", "size_mm", "offset_mm"),
    "readout": ("axis", "direction", "first", "ratio", "fps", "readout_ms"),
}
_WORDS = ("title",)
MOST_LINES = 65_536  # a panel has at most this many rows or columns


@dataclass(frozen=True)
class Scanner:
    """A scanner: geometry, imaged volume, and how its panel is read by default.

    readout_ratio: readout / exposure time, T_ro/T_exp; None takes the protocol's. pulse: start and length of the beam's
    pulse in a frame, as fractions of the exposure; None for a steady beam. lag: the fraction λ of a frame that stems from
    earlier frames. fps, readout_ms: frame rate and readout from a data sheet, or None."""

    name: str
    geometry: Geometry
    grid: Grid
    readout_axis: str = "rows"
    readout_direction: int = 1
    readout_ratio: float | None = None
    pulse: tuple[float, float] | None = None
    lag: float = 0.0
    fps: float | None = None
    readout_ms: float | None = None


def load_scanner(name_or_path: str | Path, data_dir: Path) -> Scanner:
    """Loads a scanner by name (``data_dir``/NAME.toml) or from a path that ends in .toml. Raises InputError for an unknown
    scanner and for text that is not TOML. Names unknown, missing and wrong keys as "FILE [table] key"."""
    path = _located(str(name_or_path), data_dir)
    return scanner_from(path, read_toml(path))


def with_detector_count(geometry: Geometry, rows: int, columns: int) -> Geometry:
    """Returns the geometry with other numbers of pixels on the same panel. Raises InputError for numbers below 1."""
    if min(rows, columns) < 1:
        raise InputError("detector count", f"{rows} × {columns}", "at least 1 row and 1 column")
    (nv, nu), (pitch_v, pitch_u) = geometry.detector_shape, geometry.pixel_size_mm
    pitch_mm = (pitch_v * nv / rows, pitch_u * nu / columns)
    return replace(geometry, detector_shape=(rows, columns), pixel_size_mm=pitch_mm)


def _located(name: str, data_dir: Path) -> Path:
    if name.endswith(".toml") or "/" in name or "\\" in name:
        return Path(name)
    names = sorted(path.stem for path in Path(data_dir).glob("*.toml") if _describes_scanner(path))
    if name not in names:
        remedy = suggest_name(name, names, "or give the path of a .toml file")
        raise InputError("scanner", repr(name), f"one of {', '.join(names)}" if names else "a path", remedy)
    return Path(data_dir) / f"{name}.toml"


def _describes_scanner(path: Path) -> bool:
    """Returns whether a TOML file has a table [source], as every scanner has; the folder may hold other files."""
    try:
        return "source" in read_toml(path)
    except InputError:
        return False


def scanner_from(path: Path, content: dict[str, object]) -> Scanner:
    """Returns the scanner that ``content`` of the TOML file ``path`` describes. Raises InputError as ``load_scanner``."""
    refuse_unknown(str(path), content, (*TABLES, *_WORDS), "a table")
    tables = {name: Fields(f"{path} [{name}]", content.get(name, {}), keys) for name, keys in TABLES.items()}
    geometry = _geometry(tables["source"], tables["detector"])
    readout, beam = tables["readout"], tables["beam"]
    axis, direction = _order(readout)
    fps = readout.length("fps") if readout.has("fps") else None
    readout_ms = readout.number("readout_ms", lowest=0.0) if readout.has("readout_ms") else None
    if readout.has("ratio") and readout_ms is not None:
        raise readout.error("readout_ms", f"{readout_ms:g} with ratio", "one of the two", "leave ratio out")
    return Scanner(
        path.stem, geometry, _grid(tables["volume"]) if "volume" in content else default_grid(geometry), axis,
        direction,
        readout.number("ratio", lowest=0.0, highest=LARGEST_LENGTH) if readout.has("ratio") else None,
        (beam.number("pulse_start", highest=LARGEST_LENGTH), beam.length("pulse_length")) if "beam" in content else None,
        tables["detector"].number("lag", 0.0, 0.0, LARGEST_LAG), fps, readout_ms,
    )


def _order(readout: Fields) -> tuple[str, int]:
    """Returns readout axis and direction, from the key ``first`` or from ``axis`` and ``direction``; by default rows from
    the lowest up. Raises InputError for contradictions."""
    direction = readout.get("direction") if readout.has("direction") else 1
    if isinstance(direction, bool) or direction not in (1, -1):
        expected, remedy = "1 (index 0 first) or -1 (index 0 last)", 'a side in words goes into first, as first = "top"'
        raise readout.error("direction", described(direction), expected, remedy)
    axis, stated = readout.word("axis", AXES, default=AXES[0]), 1 if direction == 1 else -1
    if not readout.has("first"):
        return axis, stated

    def named(field: str) -> str:
        return readout.name(field) if field == "first" else field.removeprefix("readout_")

    given = axis if readout.has("axis") else None, stated if readout.has("direction") else None
    order = readout_order(readout.word("first"), *given, named)
    return order[0] or axis, order[1] or stated


def _geometry(source: Fields, detector: Fields) -> Geometry:
    distances_mm = ("to_axis_mm", "to_detector_mm")
    if is_parallel := source.word("beam", BEAMS, default="cone") == "parallel":
        for key in filter(source.has, distances_mm):
            found, remedy = described(source.get(key)), "leave one of the two out"
            raise source.error(key, found, "no distance: beam is 'parallel'", remedy)
    to_axis_mm, to_detector_mm = (0.0, 1.0) if is_parallel else map(source.length, distances_mm)
    if to_detector_mm <= to_axis_mm:
        raise source.error("to_detector_mm", f"{to_detector_mm:g}", f"more than to_axis_mm ({to_axis_mm:g})")
    panel = (  # each (v, u)
        (detector.count("rows", MOST_LINES), detector.count("columns", MOST_LINES)),
        (detector.length("pixel_size_v_mm"), detector.length("pixel_size_u_mm")),
        (detector.position("offset_v_mm"), detector.position("offset_u_mm")),
    )
    return ParallelGeometry(*panel) if is_parallel else ConeGeometry(to_axis_mm, to_detector_mm, *panel)


def _grid(volume: Fields) -> Grid:
    shape, size_mm, offset_mm = (
        triple(volume.numbers(key, 3, LARGEST_LENGTH).tolist()) if volume.has(key) or key != "offset_mm" else (0.0,) * 3
        for key in ("shape", "size_mm", "offset_mm")
    )
    if any(n < 1 or n != int(n) for n in shape):
        raise volume.error("shape", str(list(shape)), "three counts of at least 1 (z, y, x)")
    if math.prod(shape) > MOST_VOXELS:
        raise volume.error("shape", checks.short_repr(list(shape)), f"at most {MOST_VOXELS:.3g} voxels")
    if min(size_mm) < 1 / LARGEST_LENGTH:
        raise volume.error("size_mm", str(list(size_mm)), "three lengths above 0 (z, y, x)")
    voxel_mm = triple(side / n for side, n in zip(size_mm, shape, strict=True))
    return Grid(triple(int(n) for n in shape), voxel_mm, offset_mm)
