"""RTK's geometry files (RTKThreeDCircularGeometry, version 3): nine numbers per projection, and the poses they mean.

Read with expat alone: no entity is declared, no external file is looked at. RTK's own files carry an empty
DOCTYPE, which is harmless and the only one that passes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.bounded import read_bytes

ROOT = "RTKThreeDCircularGeometry"
NAMES = (
    *("SourceToIsocenterDistance", "SourceToDetectorDistance", "GantryAngle"),
    *("SourceOffsetX", "SourceOffsetY", "ProjectionOffsetX", "ProjectionOffsetY"),
    *("InPlaneAngle", "OutOfPlaneAngle"),
)
_REQUIRED = ("SourceToIsocenterDistance", "SourceToDetectorDistance", "GantryAngle")
_ANGLES = ("GantryAngle", "InPlaneAngle", "OutOfPlaneAngle")
_MOST_DEPTH = 8
_LARGEST = 1e9
# RTK's axes (X, Y, Z) are (y, z, x) here: the same right-handed frame under other names.
_TO_WORLD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class RtkGeometry:
    """Numbers of all projections: each (F,), lengths in mm, angles in radians, by RTK's names."""

    values: dict[str, np.ndarray]

    @property
    def frames(self) -> int:
        """How many projections there are."""
        return len(self.values["GantryAngle"])

    @property
    def is_circular(self) -> bool:
        """Whether every projection stands on one untilted circle with one panel."""
        still = all(np.ptp(self.values[name]) <= 1e-9 * (1 + np.abs(v).max()) for name, v in self.steady)
        tilts = ("SourceOffsetX", "SourceOffsetY", "InPlaneAngle", "OutOfPlaneAngle")
        return still and all(np.all(self.values[name] == 0) for name in tilts)

    @property
    def steady(self) -> list[tuple[str, np.ndarray]]:
        """Everything but the gantry's angle."""
        return [(name, values) for name, values in self.values.items() if name != "GantryAngle"]

    def poses(
        self, position: np.ndarray, origin_mm: np.ndarray, step_u: np.ndarray, step_v: np.ndarray
    ) -> np.ndarray:
        """Poses (T, 12) at frame positions (T,), numbers between and beyond frames by straight lines.

        ``origin_mm`` (2,): place (u, v) of pixel (0, 0) in the image's own plane; ``step_u``, ``step_v`` (2,): steps
        from column to column and row to row there.
        """
        at = {
            name: _along(np.unwrap(v) if name in _ANGLES else v, position) for name, v in self.values.items()
        }
        turn = _rotations(at)
        to_detector = at["SourceToIsocenterDistance"] - at["SourceToDetectorDistance"]
        shift = np.stack([at["ProjectionOffsetX"], at["ProjectionOffsetY"], to_detector], -1)
        first = shift + np.array([*origin_mm, 0.0])
        offsets = [at["SourceOffsetX"], at["SourceOffsetY"], at["SourceToIsocenterDistance"]]
        steps = [np.broadcast_to([*step, 0.0], first.shape) for step in (step_u, step_v)]
        parts = [
            np.einsum("tij,tj->ti", turn, part) @ _TO_WORLD.T
            for part in (np.stack(offsets, -1), first, *steps)
        ]
        return np.concatenate(parts, -1)


def read_rtk_xml(path: Path) -> RtkGeometry:
    """All projections of a geometry file."""
    reader = _Reader(str(path))
    reader.parse(read_bytes(path))
    if not reader.projections:
        raise InputError(str(path), "no Projection", "at least one")
    columns = {}
    for name in NAMES:
        column = [projection.get(name, reader.common.get(name)) for projection in reader.projections]
        if name in _REQUIRED and None in column:
            found = f"no {name} for projection {column.index(None)}"
            raise InputError(str(path), found, "one, in the projection or above all of them")
        values = np.array([0.0 if value is None else value for value in column])
        columns[name] = np.deg2rad(values) if name in _ANGLES else values
    for name in _REQUIRED[:2]:
        if columns[name].min() <= 0:
            raise InputError(f"{path} {name}", f"{columns[name].min():g}", "a length above 0")
    if np.any(columns[_REQUIRED[1]] <= columns[_REQUIRED[0]]):
        expected = "more than SourceToIsocenterDistance"
        raise InputError(f"{path} {_REQUIRED[1]}", f"{columns[_REQUIRED[1]].min():g}", expected)
    return RtkGeometry(columns)


def _along(values: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Values (F,) at positions (T,): linear between frames and, by the last step, beyond them."""
    if len(values) == 1:
        return np.full(position.shape, values[0])
    left = np.clip(np.floor(position).astype(int), 0, len(values) - 2)
    return values[left] + (position - left) * (values[left + 1] - values[left])


def _rotations(at: dict[str, np.ndarray]) -> np.ndarray:
    """(T, 3, 3) from the gantry's frame to RTK's fixed one: inverse of Rz(−in plane) Rx(−out of plane) Ry(−gantry)."""
    y, x, z = (at[name] for name in ("GantryAngle", "OutOfPlaneAngle", "InPlaneAngle"))
    zero, one = np.zeros_like(y), np.ones_like(y)

    def matrix(*rows: np.ndarray) -> np.ndarray:
        return np.stack(rows, -1).reshape(*y.shape, 3, 3)

    about_y = matrix(np.cos(y), zero, np.sin(y), zero, one, zero, -np.sin(y), zero, np.cos(y))
    about_x = matrix(one, zero, zero, zero, np.cos(x), -np.sin(x), zero, np.sin(x), np.cos(x))
    about_z = matrix(np.cos(z), -np.sin(z), zero, np.sin(z), np.cos(z), zero, zero, zero, one)
    return about_y @ about_x @ about_z


class _Reader:
    """Collects the numbers; everything that RTK does not write is refused, or passed over if it moves nothing."""

    def __init__(self, culprit: str) -> None:
        self.culprit = culprit
        self.common: dict[str, float] = {}
        self.projections: list[dict[str, float]] = []
        self._path: list[str] = []
        self._text: list[str] = []

    def parse(self, data: bytes) -> None:
        """Read a whole file."""
        parser = expat.ParserCreate()
        parser.StartDoctypeDeclHandler = self._doctype
        parser.EntityDeclHandler = lambda *_: self._refuse("an entity declaration")
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._text.append
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise InputError(self.culprit, f"XML that is not well formed ({error})", f"a {ROOT}") from error
        except (ValueError, LookupError) as error:  # an encoding that nobody knows
            raise InputError(self.culprit, f"XML that cannot be read ({error})", f"a {ROOT}") from error

    def _refuse(self, found: str) -> None:
        raise InputError(self.culprit, found, "plain elements", "nothing outside of the file is read")

    def _doctype(self, name: str, system: str | None, public: str | None, subset: int) -> None:
        if system or public or subset:
            self._refuse("a DOCTYPE with declarations or an external file")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if not self._path:
            if name != ROOT:
                raise InputError(self.culprit, f"a root element {name[:60]!r}", ROOT)
            if attributes.get("version", "3") != "3":
                raise InputError(self.culprit, f"version {attributes['version'][:20]!r}", "version 3")
        self._path.append(name)
        if len(self._path) > _MOST_DEPTH:
            self._refuse(f"elements nested more than {_MOST_DEPTH} deep")
        if self._path[1:] == ["Projection"]:
            self.projections.append({})
        self._text.clear()

    def _end(self, name: str) -> None:
        inside = self._path[1:-1]
        if name in (*NAMES, "RadiusCylindricalDetector") and inside in ([], ["Projection"]):
            value = self._number(name)
            if name in NAMES:
                (self.projections[-1] if inside else self.common)[name] = value
            elif value != 0:
                raise InputError(f"{self.culprit} {name}", f"{value:g}", "a flat panel")
        self._path.pop()
        self._text.clear()

    def _number(self, name: str) -> float:
        text = "".join(self._text).strip()
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not abs(value) <= _LARGEST:
            raise InputError(f"{self.culprit} {name}", repr(text[:40]), "a finite number")
        return value
