"""A jaw-like voxel phantom: a mandible with its rami and a row of teeth in soft tissue, made of simple bodies.

The mandible's body is an ellipse moved along a horizontal arc. Rami and roots are tapered capsules. Crowns are small
ellipsoids with an enamel cap. The chin points to -y, the teeth to +z. Lengths are in units of half the cube's side."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from phyradgs_cl.checks import at_least
from phyradgs_cl.phantoms import implicit
from phyradgs_cl.phantoms.implicit import Capsule, Field, Lattice, Point

# Attenuation of each tissue, as a fraction of enamel's.
_CORTICAL, _TRABECULAR, _NERVE = 0.85, 0.50, 0.28
_ENAMEL, _DENTINE, _PULP = 1.0, 0.72, 0.30
_MUSCLE, _FAT = 0.24, 0.18
_SHELL = 0.035  # thickness of cortical bone
_ENAMEL_DEPTH, _FAT_DEPTH = 0.020, 0.05  # thickness of enamel, and of fat
_BONE_BLEND, _FLESH_BLEND = 0.025, 0.04  # widths over which bodies that touch merge smoothly

# The arc of the mandible: x = A sin(phi), y = Y0 - B cos(phi), phi from -_PHI_END to +_PHI_END.
_ARC_A, _ARC_B, _ARC_Y0 = 0.60, 0.86, 0.22
_PHI_END = 0.46 * np.pi
_BODY_Z, _BODY_HEIGHT, _BODY_WIDTH = -0.26, 0.19, 0.105  # section of the arc: z of its centre, semi-axes along z and across
_GUM_Z = -0.08  # upper rim of the bone, where the crowns begin
# Teeth of one side, from the middle: width along the arc, width across, crown height, number of roots.
_TEETH = (
    (0.085, 0.085, 0.13, 1),
    (0.090, 0.090, 0.13, 1),
    (0.105, 0.105, 0.15, 1),
    (0.105, 0.110, 0.13, 1),
    (0.110, 0.115, 0.12, 1),
    (0.150, 0.145, 0.12, 2),
    (0.150, 0.145, 0.11, 2),
)
_FIRST_GAP = 0.006  # distance along the arc from its middle to the first tooth on either side


@dataclass(frozen=True)
class Tooth:
    """A tooth with its centre (x, y) on the arc. along: the arc's unit direction there. Sizes as in `_TEETH`."""

    centre: tuple[float, float]
    along: tuple[float, float]
    width: float
    depth: float
    height: float
    roots: int


def jaw(grid_shape: int, seed: int) -> Field:
    """Returns relative attenuation (n, n, n) float32 (z, y, x) in [0, 1], air exactly 0, for n = ``grid_shape``. The jaw
    fits into the cube's inscribed cylinder. A ``seed`` gives the same jaw at every n. Raises InputError for n below 4."""
    at_least("grid_shape", grid_shape, 4)
    rng = np.random.default_rng(seed)
    teeth = _teeth(rng)
    lattice = Lattice(int(grid_shape))
    ripple = np.float32(0.005) * implicit.texture(lattice, (0.15, 0.4), 48, rng)
    bone = _bone_distance(lattice) + ripple
    volume = _soft_tissue(lattice, bone, rng)
    _fill_bone(volume, lattice, bone, rng)
    for tooth in teeth:
        _add_tooth(volume, lattice, tooth)
    return volume


def _arc(phi: float) -> tuple[float, float]:
    return (_ARC_A * float(np.sin(phi)), _ARC_Y0 - _ARC_B * float(np.cos(phi)))


def _teeth(rng: np.random.Generator) -> list[Tooth]:
    """Returns fourteen teeth side by side along the arc. ``rng`` varies their sizes a little."""
    phi = np.linspace(0.0, _PHI_END, 2000)
    x, y = _ARC_A * np.sin(phi), _ARC_Y0 - _ARC_B * np.cos(phi)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    teeth = []
    for side in (-1.0, 1.0):
        position = _FIRST_GAP
        for width, depth, height, roots in _TEETH:
            w, d, h = (v * (1 + 0.05 * rng.uniform(-1, 1)) for v in (width, depth, height))
            at = float(np.interp(position + w / 2, length, phi))
            position += w
            slope = np.array([_ARC_A * np.cos(at), _ARC_B * np.sin(at)])
            slope /= np.linalg.norm(slope)
            px, py = _arc(at)
            along = (side * float(slope[0]), float(slope[1]))
            teeth.append(Tooth((side * px, py), along, w, d, h, roots))
    return teeth


def _arc_distance(lattice: Lattice) -> Field:
    """Returns the horizontal distance (1, n, n) from each vertical column of voxels to the mandible's arc."""
    axis = lattice.axis()
    x, y = axis[None, :], axis[:, None]
    nearest = np.full((lattice.count, lattice.count), np.inf, dtype=np.float32)
    points = [_arc(phi) for phi in np.linspace(-_PHI_END, _PHI_END, 49)]
    zero = np.zeros((1, 1), dtype=np.float32)
    for (x0, y0), (x1, y1) in pairwise(points):
        piece = Capsule((x0, y0, 0.0), (x1, y1, 0.0), 0.0, 0.0)
        nearest = np.minimum(nearest, implicit.capsule_distance(piece, x, y, zero))
    return nearest[None]


def _rami() -> list[Capsule]:
    """Returns both rami: the angle, a flat blade of three capsules, coronoid process and condyle."""
    capsules = []
    for side in (-1.0, 1.0):
        x, y = _arc(_PHI_END)
        x *= side

        def at(dx: float, dy: float, z: float, x: float = x, y: float = y, side: float = side) -> Point:
            return (x + side * dx, y + dy, z)

        capsules += [
            Capsule(at(0.0, -0.06, -0.26), at(0.02, 0.14, -0.20), 0.12, 0.09),
            Capsule(at(0.02, 0.14, -0.20), at(0.03, 0.26, 0.42), 0.085, 0.06),
            Capsule(at(0.01, 0.04, -0.14), at(0.03, 0.16, 0.32), 0.085, 0.06),
            Capsule(at(0.01, -0.02, -0.12), at(0.03, 0.05, 0.46), 0.080, 0.03),
            Capsule(at(-0.03, 0.28, 0.50), at(0.06, 0.26, 0.50), 0.070, 0.065),
        ]
    return capsules


def _bone_distance(lattice: Lattice) -> Field:
    _, _, z = lattice.points(lattice.everything)
    section = (np.float32(_BODY_WIDTH), np.float32(_BODY_HEIGHT))
    body = implicit.ratio_distance((_arc_distance(lattice), z - np.float32(_BODY_Z)), section)
    front = _arc(0.0)[1]
    chin = Capsule((-0.08, front - 0.02, -0.38), (0.08, front - 0.02, -0.38), 0.10, 0.10)
    return implicit.capsule_union(lattice, [chin, *_rami()], _BONE_BLEND, lattice.everything, [body])


def _soft_tissue(lattice: Lattice, bone: Field, rng: np.random.Generator) -> Field:
    """Returns the attenuation of flesh around the bone, of the mouth's floor, tongue and throat, under fat. Air is 0."""
    x, y, z = lattice.points(lattice.everything)
    bodies = [bone - np.float32(0.075)]
    for (x0, y0, z0), axes in (
        ((0.0, -0.02, -0.28), (0.52, 0.56, 0.22)),  # floor of the mouth
        ((0.0, -0.12, -0.06), (0.30, 0.42, 0.20)),  # tongue
        ((0.0, 0.34, -0.10), (0.50, 0.34, 0.46)),  # throat
    ):
        bodies.append(implicit.ratio_distance((x - x0, y - y0, z - z0), axes))
    distance = implicit.capsule_union(lattice, [], _FLESH_BLEND, lattice.everything, bodies)
    airway = Capsule((0.0, 0.36, -0.9), (0.0, 0.30, 0.9), 0.10, 0.12)
    distance = np.maximum(distance, -implicit.capsule_distance(airway, x, y, z))
    muscle = np.float32(_MUSCLE) + np.float32(0.02) * implicit.texture(lattice, (0.12, 0.4), 48, rng)
    whole = lattice.coverage(distance)
    below = lattice.coverage(distance + np.float32(_FAT_DEPTH))
    return _FAT * (whole - below) + muscle * below


def _fill_bone(volume: Field, lattice: Lattice, distance: Field, rng: np.random.Generator) -> None:
    """Puts the bone into `volume`: a cortical shell, trabeculae inside, and in the trabeculae the canal of the nerve."""
    _, _, z = lattice.points(lattice.everything)
    outer = lattice.coverage(distance)
    inner = lattice.coverage(distance + np.float32(_SHELL))
    grain = np.float32(0.11) * implicit.texture(lattice, (0.04, 0.10), 160, rng)
    spongy = np.clip(np.float32(_TRABECULAR) + grain, 0.2, 0.8)
    canal = np.sqrt(_arc_distance(lattice) ** 2 + (z - np.float32(_BODY_Z + 0.075 - 0.15)) ** 2) - 0.022
    inside_canal = lattice.coverage(canal)
    spongy = spongy * (1 - inside_canal) + _NERVE * inside_canal
    volume[...] = volume * (1 - outer) + _CORTICAL * (outer - inner) + spongy * inner


def _add_tooth(volume: Field, lattice: Lattice, tooth: Tooth) -> None:
    middle = _GUM_Z + tooth.height / 2
    roots = _roots(tooth, 0.40 * tooth.depth, 0.016)
    crown = Capsule(_on(tooth, 0.0, middle), _on(tooth, 0.0, middle), tooth.depth, tooth.depth)
    box = implicit.capsule_box(lattice, [*roots, crown], 0.03)
    x, y, z = lattice.points(box)
    dx, dy = x - np.float32(tooth.centre[0]), y - np.float32(tooth.centre[1])
    along = dx * tooth.along[0] + dy * tooth.along[1]
    across = dx * tooth.along[1] - dy * tooth.along[0]
    axes = (0.47 * tooth.width, 0.5 * tooth.depth, 0.58 * tooth.height)
    cap = implicit.ratio_distance((along, across, z - np.float32(middle)), axes)
    root = implicit.capsule_union(lattice, roots, 0.008, box)
    canals = implicit.capsule_union(lattice, _roots(tooth, 0.014, 0.006), 0.004, box)
    pulp = np.minimum(canals, cap + 0.36 * tooth.width)
    enamel, core = lattice.coverage(cap), lattice.coverage(cap + np.float32(_ENAMEL_DEPTH))
    dentine = np.maximum(lattice.coverage(root), core)
    hollow = lattice.coverage(pulp) * dentine
    part = volume[box] * (1 - np.maximum(enamel, dentine))
    part += _ENAMEL * np.maximum(enamel - dentine, 0) + _DENTINE * (dentine - hollow) + _PULP * hollow
    volume[box] = part


def _roots(tooth: Tooth, top: float, tip: float) -> list[Capsule]:
    spread = 0.22 * tooth.width if tooth.roots == 2 else 0.0
    top = min(top, 0.26 * tooth.width) if tooth.roots == 2 else min(top, 0.42 * tooth.width)
    upper, lower = _GUM_Z + 0.02, _GUM_Z - 1.35 * tooth.height
    shifts = (-spread, spread) if tooth.roots == 2 else (0.0,)
    return [Capsule(_on(tooth, s, upper), _on(tooth, 1.2 * s, lower), top, tip) for s in shifts]


def _on(tooth: Tooth, shift: float, z: float) -> Point:
    """Returns the point at height `z` that lies `shift` along the arc from the tooth's centre."""
    return (tooth.centre[0] + shift * tooth.along[0], tooth.centre[1] + shift * tooth.along[1], z)
