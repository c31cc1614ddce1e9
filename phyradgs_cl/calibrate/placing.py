"""Finds first placements of a known phantom: rigid motions that take its beads to bright spots of a volume."""

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import center_of_mass, gaussian_filter, maximum_filter
from scipy.spatial.transform import Rotation

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

FEWEST_BEADS = 4  # three beads determine a placement, a fourth confirms it
WRONG_PHANTOM = "is it the right phantom, all of it in view, in mm? Does the gantry turn as stated ('phyradgs check')?"
_LEAST_SHARE = 0.75  # at least this fraction of the beads must lie in bright spots of the volume
_SMOOTH = 0.5  # standard deviation of the smoothing, in radii of a bead: a bead of many voxels then has one maximum
_PEAKS_PER_BEAD = 2.0  # about (number of bright spots compared with beads) / (number of beads): some spots are no beads
_TOLERANCE_VOXELS = 1.5  # largest distance of a bead from its bright spot, in voxels
_TRIANGLES = 40  # number of random triangles of beads that are compared with triangles of spots, to find placements
_APART = 0.05  # placements whose turns differ by at most this, in rad, count as one
_MOST = 6  # most placements that are returned: a nearly symmetric phantom fits equally well in several


def bead_centres_mm(phantom: EllipsoidPhantom) -> np.ndarray:
    """Returns the centres (n, 3) in mm of a phantom's beads. Raises InputError for fewer than four, or beads on a line."""
    centres_mm = np.array([body.centre_mm for body in phantom.ellipsoids if isinstance(body, Ellipsoid)]).reshape(-1, 3)
    spread_mm = np.linalg.svd(centres_mm - centres_mm.mean(0), compute_uv=False) if len(centres_mm) else np.zeros(3)
    if len(centres_mm) < FEWEST_BEADS or spread_mm[1] < 0.01 * spread_mm[0]:
        on_a_line = " on a line" if len(centres_mm) >= FEWEST_BEADS else ""
        expected = f"at least {FEWEST_BEADS} beads that do not lie on a line"
        raise InputError("--phantom", f"{len(centres_mm)} beads{on_a_line}", expected)
    return centres_mm


def placements(phantom: EllipsoidPhantom, volume: np.ndarray, grid: Grid) -> list[np.ndarray]:
    """Returns up to 6 placements (6,), the best first, that take most of the known beads to bright spots of ``volume`` (nz,
    ny, nx).

    A placement is a turn (rotation vector, rad) and a shift (mm). Raises InputError if none takes 3/4 of the beads, at
    least three, to bright spots."""
    beads_mm = bead_centres_mm(phantom)
    radius_mm = np.median([body.reach_mm for body in phantom.ellipsoids if isinstance(body, Ellipsoid)])
    smooth = gaussian_filter(volume, _SMOOTH * radius_mm / np.array(grid.voxel_size_mm))
    spots_mm = _peaks_mm(smooth, grid, int(_PEAKS_PER_BEAD * len(beads_mm)) + FEWEST_BEADS)
    within_mm = _TOLERANCE_VOXELS * max(grid.voxel_size_mm)
    matches: list[tuple[int, float, np.ndarray]] = []  # −(number of beads found), mean distance in mm, placement
    for three, corners in _matching_triangles(beads_mm, spots_mm, within_mm):
        place = _rigid(beads_mm[list(three)], spots_mm[corners])
        for _ in range(2):  # fits the placement again, to all beads that it takes near a spot
            apart_mm = np.linalg.norm(_moved(place, beads_mm)[:, None] - spots_mm, axis=-1)
            near = apart_mm.min(1) < within_mm
            if near.sum() < 3:
                break
            place = _rigid(beads_mm[near], spots_mm[apart_mm[near].argmin(1)])
        matches.append((-int(near.sum()), float(np.mean(np.minimum(apart_mm.min(1), within_mm))), place))
    matches.sort(key=lambda one: one[:2])
    most = -matches[0][0] if matches else 0
    if most < max(_LEAST_SHARE * len(beads_mm), FEWEST_BEADS - 1):
        matched = f"{most} of {len(beads_mm)} beads where they should be"
        raise InputError("--phantom", matched, f"{100 * _LEAST_SHARE:.0f} % or more", WRONG_PHANTOM)
    best: list[np.ndarray] = []
    for count, _, place in matches:
        if -count < most - 1 or len(best) == _MOST:
            break
        turn = Rotation.from_rotvec(place[:3])
        if all((turn.inv() * Rotation.from_rotvec(other[:3])).magnitude() > _APART for other in best):
            best.append(place)
    return best


def _peaks_mm(volume: np.ndarray, grid: Grid, most: int) -> np.ndarray:
    """Returns up to ``most`` bright spots (m, 3), x y z in mm, of a volume (nz, ny, nx): centroids of the 3³ voxels about
    its largest positive local maxima. Maxima at the volume's faces do not count."""
    peaks = np.argwhere((volume == maximum_filter(volume, 3)) & (volume > 0))
    peaks = peaks[((peaks > 0) & (peaks < np.array(volume.shape) - 1)).all(1)]
    places = []
    for peak in peaks[np.argsort(-volume[tuple(peaks.T)])[:most]]:
        around = volume[tuple(slice(at - 1, at + 2) for at in peak)]
        weight = around - around.min() if np.ptp(around) > 0 else np.ones(around.shape)
        places.append((peak - 1 + center_of_mass(weight)) * grid.voxel_size_mm + grid.first_centre_mm)
    return np.array(places).reshape(-1, 3)[:, ::-1]


def _matching_triangles(
    beads_mm: np.ndarray, spots_mm: np.ndarray, within_mm: float
) -> Iterator[tuple[tuple[int, int, int], list[int]]]:
    """Yields indices of three beads and three spots whose triangles have the same sides within ``within_mm``. Three of the
    beads (n, 3) are chosen at random; triangles with a side below 3 · ``within_mm`` are left out. spots_mm: (m, 3)."""
    rng = np.random.default_rng(0)
    apart = np.linalg.norm(spots_mm[:, None] - spots_mm, axis=-1)
    for _ in range(_TRIANGLES):
        a, b, c = map(int, rng.permutation(len(beads_mm))[:3])
        ab, bc, ca = (float(np.linalg.norm(beads_mm[i] - beads_mm[j])) for i, j in ((a, b), (b, c), (c, a)))
        if min(ab, bc, ca) < 3 * within_mm:
            continue
        for i, j in np.argwhere(np.abs(apart - ab) < within_mm):
            for k in np.flatnonzero((np.abs(apart[j] - bc) < within_mm) & (np.abs(apart[i] - ca) < within_mm)):
                yield (a, b, c), [int(i), int(j), int(k)]


def _rigid(points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Returns the turn (rad) and shift (mm), (6,), that bring points (n, 3) nearest to targets (n, 3), both in mm."""
    middle, there = points.mean(0), targets.mean(0)
    turn, _ = Rotation.align_vectors(targets - there, points - middle)
    return np.concatenate([turn.as_rotvec(), there - turn.apply(middle)])


def _moved(place: np.ndarray, points: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(place[:3]).apply(points) + place[3:]
