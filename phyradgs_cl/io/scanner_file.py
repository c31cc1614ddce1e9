"""Scanner descriptions: a small TOML file with a geometry, a volume and how the panel reads out."""

from __future__ import annotations

import difflib
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from phyradgs_cl import checks
from phyradgs_cl.acquisition import ConeGeometry
from phyradgs_cl.acquisition.scan import LARGEST_LAG
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.fields.volume import MOST_VOXELS
from phyradgs_cl.io.grid_io import default_grid
from phyradgs_cl.io.units import LENGTH

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_TABLES: dict[str, tuple[str, ...]] = {
    "source": ("to_axis_mm", "to_detector_mm"),
    "detector": (
        *("rows", "columns", "pixel_size_v_mm", "pixel_size_u_mm", "offset_v_mm", "offset_u_mm"),
        "lag",
    ),
    "beam": ("pulse_start", "pulse_length"),
    "volume": ("shape", "size_mm", "offset_mm"),
    "readout": ("axis", "direction", "ratio"),
}
_WORDS = ("title",)
MOST_LINES = 65_536


@dataclass(frozen=True)
class Scanner:
    """A scanner: where things stand, what volume it images, and how its panel is read by default.

    ``readout_ratio`` is T_ro/T_exp, or None if the file leaves it to the protocol. ``pulse`` is when the beam is on
    in a frame (start, length; shares of the exposure), None always; ``lag`` the panel's λ (detector/lag.py).
    """

    name: str
    geometry: ConeGeometry
    grid: Grid
    readout_axis: str = "rows"
    readout_direction: int = 1
    readout_ratio: float | None = None
    pulse: tuple[float, float] | None = None
    lag: float = 0.0


def load_scanner(name_or_path: str | Path, data_dir: Path) -> Scanner:
    """A scanner by name (``data_dir``/NAME.toml) or from a path that ends in .toml.

    Raises:
        InputError: no such scanner, not TOML, unknown, missing or wrong keys: "FILE [table] key".
    """
    path = _located(str(name_or_path), data_dir)
    try:
        with open(path, "rb") as file:
            content = tomllib.load(file)
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a scanner file (TOML)") from error
    except (ValueError, RecursionError) as error:  # not TOML, not text, too many digits; tables too deep
        raise InputError(str(path), f"text that is not TOML ({error})", "a scanner file (TOML)") from error
    return scanner_from(path, content)


def with_detector_count(geometry: ConeGeometry, rows: int, columns: int) -> ConeGeometry:
    """The same panel, equally large and in the same place, with another number of pixels."""
    if min(rows, columns) < 1:
        raise InputError("detector count", f"{rows} × {columns}", "at least 1 row and 1 column")
    (nv, nu), (pitch_v, pitch_u) = geometry.detector_shape, geometry.pixel_size_mm
    pitch_mm = (pitch_v * nv / rows, pitch_u * nu / columns)
    return replace(geometry, detector_shape=(rows, columns), pixel_size_mm=pitch_mm)


def _located(name: str, data_dir: Path) -> Path:
    if name.endswith(".toml") or "/" in name or "\\" in name:
        if not Path(name).is_file():
            raise InputError(name, "no such file", "a scanner file (TOML)", "check the path")
        return Path(name)
    names = sorted(path.stem for path in Path(data_dir).glob("*.toml") if _describes_scanner(path))
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1)
        remedy = f"did you mean {close[0]!r}?" if close else "or give the path of a .toml file"
        raise InputError("scanner", repr(name), f"one of {', '.join(names)}" if names else "a path", remedy)
    return Path(data_dir) / f"{name}.toml"


def _describes_scanner(path: Path) -> bool:
    """Whether a TOML file has what every scanner has; other files may lie beside the scanners."""
    try:
        with open(path, "rb") as file:
            return "source" in tomllib.load(file)
    except (OSError, ValueError, RecursionError):
        return False


def scanner_from(path: Path, content: dict[str, object]) -> Scanner:
    """The scanner that a TOML file's content describes; ``path`` names it in messages."""
    _refuse_unknown(str(path), content, (*_TABLES, *_WORDS), "a table")
    tables = {name: _Table(path, name, content.get(name, {})) for name in _TABLES}
    geometry = _geometry(tables["source"], tables["detector"])
    readout = tables["readout"]
    axis = readout.get("axis", AXES[0])
    checks.one_of(readout.culprit("axis"), axis, AXES)
    direction = readout.number("direction", 1)
    checks.one_of(readout.culprit("direction"), direction, (1, -1))
    ratio = readout.number("ratio", minimum=0.0) if readout.get("ratio", None) is not None else None
    grid = _grid(tables["volume"]) if "volume" in content else default_grid(geometry)
    lag = tables["detector"].number("lag", 0.0)
    checks.within(tables["detector"].culprit("lag"), lag, 0, LARGEST_LAG)
    pulse = _pulse(tables["beam"]) if "beam" in content else None
    return Scanner(path.stem, geometry, grid, str(axis), int(direction), ratio, pulse, lag)


def _geometry(source: _Table, detector: _Table) -> ConeGeometry:
    to_axis_mm, to_detector_mm = source.positive("to_axis_mm"), source.positive("to_detector_mm")
    if to_detector_mm <= to_axis_mm:
        culprit = source.culprit("to_detector_mm")
        raise InputError(culprit, f"{to_detector_mm:g}", f"more than to_axis_mm ({to_axis_mm:g})")
    return ConeGeometry(
        to_axis_mm,
        to_detector_mm,
        (detector.count("rows"), detector.count("columns")),
        (detector.positive("pixel_size_v_mm"), detector.positive("pixel_size_u_mm")),
        (detector.number("offset_v_mm", 0.0), detector.number("offset_u_mm", 0.0)),
    )


def _pulse(beam: _Table) -> tuple[float, float]:
    start, length = beam.number("pulse_start"), beam.number("pulse_length")
    if length <= 0:
        raise InputError(beam.culprit("pulse_length"), f"{length:g}", "a share of the exposure above 0")
    return start, length


def _grid(volume: _Table) -> Grid:
    shape, size_mm = volume.triple("shape"), volume.triple("size_mm")
    offset_mm = volume.triple("offset_mm", (0.0, 0.0, 0.0))
    if any(n < 1 or n != int(n) for n in shape):
        raise InputError(volume.culprit("shape"), str(list(shape)), "three counts of at least 1 (z, y, x)")
    if math.prod(shape) > MOST_VOXELS:
        raise InputError(
            volume.culprit("shape"), checks.shown(list(shape)), f"at most {MOST_VOXELS:.3g} voxels"
        )
    if min(size_mm) < 1 / LENGTH.largest:
        raise InputError(volume.culprit("size_mm"), str(list(size_mm)), "three lengths above 0 (z, y, x)")
    voxel_mm = tuple(side / n for side, n in zip(size_mm, shape, strict=True))
    return Grid(tuple(int(n) for n in shape), voxel_mm, offset_mm)


def _refuse_unknown(culprit: str, found: dict[str, object], allowed: Sequence[str], what: str) -> None:
    for key in found:
        if key not in allowed:
            close = difflib.get_close_matches(key, allowed, n=1)
            remedy = f"did you mean {close[0]!r}?" if close else "remove it"
            raise InputError(f"{culprit} {key}", f"{what} that is not known", ", ".join(allowed), remedy)


class _Table:
    """One table of the file, whose values are taken out one by one, each checked."""

    def __init__(self, path: Path, name: str, values: object) -> None:
        self._where = f"{path} [{name}]"
        if not isinstance(values, dict):
            raise InputError(self._where, checks.shown(values), "a table of keys")
        _refuse_unknown(self._where, values, _TABLES[name], "a key")
        self._values: dict[str, object] = values

    def culprit(self, key: str) -> str:
        return f"{self._where} {key}"

    def get(self, key: str, default: object) -> object:
        return self._values.get(key, default)

    def number(self, key: str, default: float | None = None, minimum: float = -math.inf) -> float:
        value = self._values.get(key, default)
        if value is None:
            raise InputError(self.culprit(key), "nothing", "a number", "add the key")
        number = _finite(value)
        if number is None or number < minimum or abs(number) > LENGTH.largest:
            least = f" of at least {minimum:g}" if math.isfinite(minimum) else ""
            expected = f"a finite number{least}, no larger than {LENGTH.largest:g}"
            raise InputError(self.culprit(key), checks.shown(value), expected)
        return number

    def positive(self, key: str) -> float:
        value = self.number(key)
        if value < 1 / LENGTH.largest:
            raise InputError(self.culprit(key), f"{value:g}", "a length above 0")
        return value

    def count(self, key: str) -> int:
        value = self.number(key, minimum=1)
        if value != int(value) or value > MOST_LINES:
            raise InputError(self.culprit(key), f"{value:g}", f"a whole number of at most {MOST_LINES}")
        return int(value)

    def triple(
        self, key: str, default: tuple[float, float, float] | None = None
    ) -> tuple[float, float, float]:
        values = self._values.get(key, default)
        if values is None:
            raise InputError(self.culprit(key), "nothing", "three numbers [z, y, x]", "add the key")
        numbers = [_finite(value) for value in values] if isinstance(values, (list, tuple)) else []
        triple = tuple(number for number in numbers if number is not None)
        if len(numbers) != 3 or len(triple) != 3:
            raise InputError(self.culprit(key), checks.shown(values), "three finite numbers [z, y, x]")
        if max(abs(number) for number in triple) > LENGTH.largest:
            raise InputError(
                self.culprit(key), checks.shown(values), f"three numbers of at most {LENGTH.largest:g}"
            )
        return triple


def _finite(value: object) -> float | None:
    """A TOML number as a finite float, else None."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:  # TOML's whole numbers have no bounds
        return None
