"""A foot-like voxel phantom: tarsals, metatarsals and phalanges in soft tissue, made of tapered capsules.

Bones have a cortical shell with trabeculae inside. Toes point to +z, the big toe to -x, the sole to -y. Lengths are in
units of half the cube's side."""

from itertools import pairwise

import numpy as np

from phyradgs_cl.checks import at_least
from phyradgs_cl.phantoms import implicit
from phyradgs_cl.phantoms.implicit import Capsule, Field, Lattice, Point

Bone = tuple[Capsule, ...]

# Relative attenuation of each tissue: dense bone is near 1.
_CORTICAL, _TRABECULAR, _MARROW = 0.92, 0.56, 0.36
_MUSCLE, _FAT, _SKIN = 0.24, 0.18, 0.27
_SHELL = 0.022  # thickness of cortical bone
_SKIN_DEPTH, _FAT_DEPTH = 0.018, 0.06  # thickness of the skin, and of skin and fat together
_JOINT_BLEND, _SKIN_BLEND = 0.012, 0.022  # widths over which bodies that touch merge smoothly

# Tarsals and the stumps of the leg. Each bone is a chain of (x, y, z, radius).
_TARSALS: tuple[tuple[tuple[float, float, float, float], ...], ...] = (
    ((0.06, -0.21, -0.71, 0.140), (0.07, -0.11, -0.54, 0.150), (0.13, -0.08, -0.27, 0.105)),  # calcaneus
    ((-0.04, 0.16, -0.47, 0.140), (-0.12, 0.12, -0.22, 0.105)),  # talus
    ((-0.05, 0.48, -0.49, 0.165), (-0.05, 0.60, -0.50, 0.130), (-0.04, 0.74, -0.52, 0.110)),  # tibia
    ((0.18, 0.26, -0.52, 0.060), (0.19, 0.48, -0.54, 0.048), (0.18, 0.74, -0.55, 0.045)),  # fibula
    ((-0.25, 0.06, -0.02, 0.085), (-0.05, 0.11, -0.03, 0.080)),  # navicular
    ((0.17, -0.06, -0.07, 0.090), (0.19, -0.05, 0.04, 0.078)),  # cuboid
    ((-0.29, 0.03, 0.13, 0.076), (-0.30, 0.02, 0.15, 0.074)),  # medial cuneiform
    ((-0.14, 0.09, 0.12, 0.062), (-0.14, 0.09, 0.14, 0.058)),  # intermediate cuneiform
    ((0.00, 0.07, 0.12, 0.062), (0.01, 0.07, 0.15, 0.060)),  # lateral cuneiform
)
# Metatarsals with their toes: base x, y, z; head x, y, z; relative thickness; z of the toe's joints and tip.
_RAYS: tuple[tuple[Point, Point, float, tuple[float, ...]], ...] = (
    ((-0.31, 0.00, 0.23), (-0.41, -0.13, 0.51), 1.75, (0.51, 0.71, 0.86)),
    ((-0.15, 0.06, 0.20), (-0.19, -0.10, 0.56), 1.25, (0.56, 0.71, 0.80, 0.87)),
    ((0.01, 0.05, 0.21), (0.01, -0.10, 0.52), 1.20, (0.52, 0.66, 0.74, 0.81)),
    ((0.14, 0.00, 0.14), (0.20, -0.12, 0.46), 1.15, (0.46, 0.59, 0.66, 0.72)),
    ((0.26, -0.05, 0.10), (0.38, -0.14, 0.38), 1.20, (0.38, 0.50, 0.565, 0.62)),
)
# Flesh that is not around a bone: sole, arch, ball, leg.
_FLESH = (
    Capsule((0.07, -0.21, -0.66), (0.21, -0.17, 0.25), 0.18, 0.13),
    Capsule((-0.03, -0.05, -0.40), (-0.14, -0.11, 0.38), 0.23, 0.16),
    Capsule((-0.39, -0.15, 0.47), (0.35, -0.16, 0.36), 0.095, 0.085),
    Capsule((0.03, 0.15, -0.50), (0.03, 0.66, -0.52), 0.23, 0.22),
)


def foot(grid_shape: int, seed: int) -> Field:
    """Returns relative attenuation (n, n, n) float32 (z, y, x) in [0, 1], air exactly 0, for n = ``grid_shape``. The foot
    fits into the cube's inscribed cylinder. A ``seed`` gives the same foot at every n. Raises InputError for n below 4."""
    at_least("grid_shape", grid_shape, 4)
    rng = np.random.default_rng(seed)
    bones = [_chain([(p[:3], p[3]) for p in chain], rng) for chain in _TARSALS]
    bones += [_long_bone(base, head, 0.046 * thickness, rng) for base, head, thickness, _ in _RAYS]
    toes = [bone for _, head, thickness, z in _RAYS for bone in _toe(head, thickness, z, rng)]
    lattice = Lattice(int(grid_shape))
    ripple = np.float32(0.004) * implicit.texture(lattice, (0.15, 0.4), 48, rng)
    grain = implicit.texture(lattice, (0.035, 0.09), 160, rng)
    # Toes have less flesh than the rest, so that there is air between them.
    cover = [c.grown(0.06) for bone in bones for c in bone] + [c.grown(0.042) for toe in toes for c in toe]
    volume = _soft_tissue(lattice, cover, ripple, rng)
    for bone in bones + toes:
        _add_bone(volume, lattice, bone, ripple, grain)
    return volume


def _chain(points: list[tuple[Point, float]], rng: np.random.Generator) -> Bone:
    scale = 1.0 + 0.03 * rng.uniform(-1, 1)
    shift = 0.006 * rng.uniform(-1, 1, 3)
    moved = [((p[0] + shift[0], p[1] + shift[1], p[2] + shift[2]), r * scale) for p, r in points]
    return tuple(Capsule(p, q, r, s) for (p, r), (q, s) in pairwise(moved))


def _long_bone(start: Point, end: Point, radius: float, rng: np.random.Generator) -> Bone:
    """Returns a bone between two joints: wide at both ends, narrower in the middle, with a gap for the cartilage."""
    a, b = np.asarray(start), np.asarray(end)
    length = float(np.linalg.norm(b - a))
    unit = (b - a) / length
    radius = min(radius, 0.42 * length)
    gap = radius + 0.008
    ends = (a + gap * unit, b - gap * unit)
    waist = radius * 0.66
    points = (ends[0], 0.65 * ends[0] + 0.35 * ends[1], 0.3 * ends[0] + 0.7 * ends[1], ends[1])
    radii = (radius, waist, waist, radius * 0.95)
    return _chain([((float(x), float(y), float(z)), r) for (x, y, z), r in zip(points, radii, strict=True)], rng)


def _toe(head: Point, thickness: float, joints: tuple[float, ...], rng: np.random.Generator) -> list[Bone]:
    """Returns the phalanges of the toe that begins at a metatarsal's head. The toe bends slightly to the sole."""
    bones = []
    for i, (z0, z1) in enumerate(pairwise(joints)):
        spread = 0.15 * head[0]
        p = (head[0] + spread * (z0 - joints[0]), head[1] - 0.10 * (z0 - joints[0]), z0)
        q = (head[0] + spread * (z1 - joints[0]), head[1] - 0.10 * (z1 - joints[0]), z1)
        bones.append(_long_bone(p, q, 0.038 * thickness * 0.9**i, rng))
    return bones


def _soft_tissue(lattice: Lattice, cover: list[Capsule], ripple: Field, rng: np.random.Generator) -> Field:
    """Returns the attenuation (n, n, n) of muscle, fat and skin in the union of the capsules `cover` and `_FLESH`; air is 0.
    ripple: distances (n, n, n) by which the skin lies below the union's surface, above it where they are negative."""
    distance = implicit.capsule_union(lattice, [*cover, *_FLESH], _SKIN_BLEND, lattice.everything) + ripple
    muscle = np.float32(_MUSCLE) + np.float32(0.02) * implicit.texture(lattice, (0.12, 0.4), 48, rng)
    whole = lattice.coverage(distance)
    below_skin = lattice.coverage(distance + np.float32(_SKIN_DEPTH))
    below_fat = lattice.coverage(distance + np.float32(_FAT_DEPTH))
    return _SKIN * (whole - below_skin) + _FAT * (below_skin - below_fat) + muscle * below_fat


def _add_bone(volume: Field, lattice: Lattice, bone: Bone, ripple: Field, grain: Field) -> None:
    """Puts a bone into `volume`: a cortical shell, trabeculae inside, and fatty marrow in the middle. ripple: as in
    ``_soft_tissue``. grain: noise (n, n, n) in the attenuation of trabeculae and marrow."""
    box = implicit.capsule_box(lattice, bone, 0.05)
    distance = implicit.capsule_union(lattice, bone, _JOINT_BLEND, box) + ripple[box]
    outer = lattice.coverage(distance)
    inner = lattice.coverage(distance + np.float32(_SHELL))
    depth = np.clip((-distance - _SHELL) / 0.05, 0.0, 1.0)
    spongy = _TRABECULAR + (_MARROW - _TRABECULAR) * depth + np.float32(0.10) * grain[box]
    spongy = np.clip(spongy, 0.2, 0.85)
    volume[box] = volume[box] * (1 - outer) + _CORTICAL * (outer - inner) + spongy * inner
