"""Phantoms of known shape, beads and straight wires, from a TOML file (docs/formats.md)."""

from pathlib import Path

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.tables import Fields, read_toml, refuse_unknown
from phyradgs_cl.phantoms import Cylinder, Ellipsoid, EllipsoidPhantom

_MOST_BODIES = 1000
_LARGEST_MM, _LARGEST_PER_MM = 1e5, 1e5
_COMMON = "attenuation_per_mm"
_KEYS = {
    "bead": ("centre_mm", "radius_mm", _COMMON),
    "wire": ("from_mm", "to_mm", "radius_mm", _COMMON),
}


def load_beads(path: Path) -> EllipsoidPhantom:
    """Reads the beads, then the wires, of a TOML file as a phantom with the file's name. InputError: not TOML; unknown,
    missing or wrong keys; no bead; more than a thousand bodies."""
    content = read_toml(path)
    refuse_unknown(str(path), content, ("title", _COMMON, *_KEYS))
    top = Fields(str(path), content)
    beads = [
        Ellipsoid(_place(one, "centre_mm"), (one.length("radius_mm"),) * 3, _attenuation(one, top))
        for one in _bodies(top, "bead")
    ]
    wires = [
        Cylinder((_place(one, "from_mm"), _place(one, "to_mm")), one.length("radius_mm"), _attenuation(one, top))
        for one in (_bodies(top, "wire") if top.has("wire") else ())
    ]
    if len(beads) + len(wires) > _MOST_BODIES:
        raise InputError(str(path), f"{len(beads) + len(wires)} beads and wires", f"at most {_MOST_BODIES}")
    return EllipsoidPhantom((*beads, *wires), path.stem)


def _bodies(top: Fields, kind: str) -> list[Fields]:
    return [Fields(one.subject, one.values, _KEYS[kind]) for one in top.tables(kind)]


def _place(body: Fields, key: str) -> tuple[float, float, float]:
    x, y, z = body.numbers(key, 3, _LARGEST_MM).tolist()
    return x, y, z


def _attenuation(body: Fields, top: Fields) -> float:
    return (body if body.has(_COMMON) else top).number(_COMMON, lowest=-_LARGEST_PER_MM, highest=_LARGEST_PER_MM)
