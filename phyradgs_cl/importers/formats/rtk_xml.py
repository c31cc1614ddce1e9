"""RTK's geometry files (RTKThreeDCircularGeometry, version 3): nine numbers per projection, and the poses they mean.

No entity is declared, no external file looked at: an empty DOCTYPE, as in RTK's own files, is the only one that passes.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

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
_RADIUS = "RadiusCylindricalDetector"
_DECLARATIONS = re.compile(rb"<!DOCTYPE[^>]*(SYSTEM|PUBLIC|\[)")
_LARGEST = 1e9
# RTK's axes (X, Y, Z) are (y, z, x) here: the same right-handed frame under other names.
_TO_WORLD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class RtkGeometry:
    """Numbers of all projections: each (F,), lengths in mm, angles in radians, by RTK's names."""

    values: dict[str, np.ndarray]

    @property
    def frames(self) -> int:
        return len(self.values["GantryAngle"])

    @property
    def is_circular(self) -> bool:
        """Whether every projection stands on one untilted circle with one panel."""
        steady = [v for name, v in self.values.items() if name != "GantryAngle"]
        still = all(np.ptp(v) <= 1e-9 * (1 + np.abs(v).max()) for v in steady)
        tilts = ("SourceOffsetX", "SourceOffsetY", "InPlaneAngle", "OutOfPlaneAngle")
        return still and all(np.all(self.values[name] == 0) for name in tilts)

    def poses(
        self, position: np.ndarray, origin_mm: np.ndarray, step_u: np.ndarray, step_v: np.ndarray
    ) -> np.ndarray:
        """Poses (T, 12) at frame positions (T,), straight lines between and beyond frames. ``origin_mm`` (2,): place (u, v)
        of pixel (0, 0) in the image's plane; ``step_u``, ``step_v`` (2,): from column to column and row to row."""
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
    root = _root(path)
    common, projections = _numbers(path, root), [_numbers(path, e) for e in root.iterfind("Projection")]
    if not projections:
        raise InputError(str(path), "no Projection", "at least one")
    columns = {}
    for name in NAMES:
        column = [projection.get(name, common.get(name)) for projection in projections]
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


def _root(path: Path) -> ElementTree.Element:
    data, subject = read_bytes(path), str(path)
    if _DECLARATIONS.search(data):
        expected, remedy = "plain elements", "nothing outside of the file is read"
        raise InputError(subject, "a DOCTYPE with declarations or an external file", expected, remedy)
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise InputError(subject, f"XML that is not well formed ({error})", f"a {ROOT}") from error
    except (ValueError, LookupError) as error:  # an encoding that nobody knows
        raise InputError(subject, f"XML that cannot be read ({error})", f"a {ROOT}") from error
    if root.tag != ROOT:
        raise InputError(subject, f"a root element {root.tag[:60]!r}", ROOT)
    if (version := root.get("version", "3")) != "3":
        raise InputError(subject, f"version {version[:20]!r}", "version 3")
    return root


def _numbers(path: Path, parent: ElementTree.Element) -> dict[str, float]:
    """The numbers right inside an element by their names; others are passed over, but for a panel that is curved."""
    values = {e.tag: _number(f"{path} {e.tag}", e.text) for e in parent if e.tag in (*NAMES, _RADIUS)}
    if radius := values.pop(_RADIUS, 0.0):
        raise InputError(f"{path} {_RADIUS}", f"{radius:g}", "a flat panel")
    return values


def _number(subject: str, text: str | None) -> float:
    text = (text or "").strip()
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= _LARGEST:
        raise InputError(subject, repr(text[:40]), "a finite number")
    return value
