"""The curves of the prior ``curves``: the linear denoiser of block cosine transforms with the least error on white noise.

    python benchmarks/train_curves.py data/curves.json
    python benchmarks/train_curves.py other.json --volumes A.h5 B.h5

A volume v with noise of deviation σ loses Σ_k,m α_km B_km(v): B_km clips the coefficients of class k at ± knot_m σ and
averages over all shifts of the blocks. That is linear in the numbers α_km, so the best ones solve one system of normal
equations, summed over cubes and noises. The squared error of a cube counts relative to itself. Without ``--volumes``, cubes
come from procedural volumes, which this script and ``phantoms`` draw: solids with texture, foams, vessels, foot, jaw."""

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import scipy

from phyradgs_cl.fields import Grid
from phyradgs_cl.importers import load_attenuation
from phyradgs_cl.metrics.align import block_means
from phyradgs_cl.objective.dct_prox import CLASSES, EDGE, FREQUENCY_CLASSES
from phyradgs_cl.phantoms import make_phantom

KNOTS = (0.8, 1.8, 5.0, 13.0)  # in σ; ten knots gain 0.05 dB on white noise
NOISES = (0.008, 0.016, 0.03, 0.05)  # σ, of a volume's range
CUBE = 32  # voxels per side
DRAWN = 128  # voxels per side of procedural volumes, before means of 2³
RIDGE = 1e-5  # of the mean diagonal of the normal equations
ROUNDS = 4  # of weights by each cube's least error
_BASIS = scipy.fft.dct(np.eye(EDGE), axis=0, norm="ortho").astype(np.float32)  # (frequency, place)


def band_of_noise(rng: np.random.Generator, width: float) -> np.ndarray:
    """Returns periodic noise of deviation 1 (DRAWN, DRAWN, DRAWN), smoothed by a Gaussian of ``width`` voxels."""
    along = np.exp(-2 * (np.pi * width * np.fft.fftfreq(DRAWN)) ** 2)
    spectrum = scipy.fft.rfftn(rng.standard_normal((DRAWN,) * 3, np.float32))
    spectrum *= (along[:, None, None] * along[:, None] * along[: DRAWN // 2 + 1]).astype(np.float32)
    smooth = scipy.fft.irfftn(spectrum, (DRAWN,) * 3)
    return smooth / smooth.std()


def solids(rng: np.random.Generator) -> np.ndarray:
    """Returns textured ellipsoids, boxes and shells in air."""
    places = np.meshgrid(*[np.linspace(-1, 1, DRAWN, dtype=np.float32)] * 3, indexing="ij", sparse=True)
    volume, grains = np.zeros((DRAWN,) * 3, np.float32), [band_of_noise(rng, width) for width in (0.8, 1.5, 3)]
    for _ in range(14):
        centre, half = rng.uniform(-0.6, 0.6, 3), rng.uniform(0.06, 0.45, 3)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0].astype(np.float32)
        along = [sum(turn[i, j] * (p - centre[j]) for j, p in enumerate(places)) / half[i] for i in range(3)]
        radius = np.maximum.reduce([abs(a) for a in along]) if rng.random() < 0.4 else np.sqrt(sum(a * a for a in along))
        inside = radius < 1
        if rng.random() < 0.3:
            inside &= radius > rng.uniform(0.6, 0.9)
        volume[inside] = rng.uniform(0.1, 1) + rng.choice([0, 0.03, 0.1]) * grains[rng.integers(3)][inside]
    return volume


def foam(rng: np.random.Generator) -> np.ndarray:
    """Returns walls between pores, where a band of noise is near its mean, or grains that touch."""
    band = band_of_noise(rng, rng.uniform(3, 9))
    if rng.random() < 0.5:
        return (abs(band) < rng.uniform(0.25, 0.6)).astype(np.float32)
    grain = rng.uniform(0.05, 0.2) * band_of_noise(rng, 1.5)
    return np.where(band > rng.uniform(-0.3, 0.5), 0.7 + grain, 0).astype(np.float32)


def vessels(rng: np.random.Generator) -> np.ndarray:
    """Returns bright tubes along random walks in soft material with texture."""
    volume = np.float32(0.25) + np.float32(0.03) * band_of_noise(rng, 2.5)
    for radius in (0.8, 1.2, 1.8, 2.5, 4, 7):
        marks = np.ones((DRAWN,) * 3, bool)
        for _ in range(5):
            heading = np.cumsum(rng.normal(size=(4 * DRAWN, 3)) / 4, 0)
            path = rng.uniform(0, DRAWN, 3) + np.cumsum(heading / np.linalg.norm(heading, axis=1, keepdims=True), 0) / 2
            marks[tuple((path.astype(int) % DRAWN).T)] = False
        volume[scipy.ndimage.distance_transform_edt(marks) < radius] = rng.uniform(0.4, 1)
    return volume


def procedural_volumes(seed: int) -> Iterator[np.ndarray]:
    """Draws volumes at twice the resolution, so that edges pass through voxels."""
    rng = np.random.default_rng(seed)
    for draw in (solids, foam, vessels, solids, foam, solids, foam, vessels):
        yield block_means(draw(rng), (2, 2, 2))
    for name in ("foot", "jaw"):
        for size in (64, 96):
            yield make_phantom(name, 1.0, size).voxelise(Grid.cube(size, 2.0))


def file_volumes(paths: list[Path]) -> Iterator[np.ndarray]:
    """Loads volumes, at their own resolution and at half of it."""
    for path in paths:
        volume = np.asarray(load_attenuation(path).values, np.float32)
        yield volume
        yield block_means(volume, (2, 2, 2))


def cubes_of(volume: np.ndarray, count: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Draws cubes that are not flat, in units of the volume's range."""
    volume = volume / volume.max()
    for _ in range(20 * count):
        first = [rng.integers(0, n - CUBE + 1) for n in volume.shape]
        cube = volume[tuple(slice(f, f + CUBE) for f in first)]
        if cube.std() > 0.03:
            yield cube
            count -= 1
        if not count:
            return


def features(noisy: np.ndarray, sigma: float, knots: np.ndarray) -> np.ndarray:
    """Returns B_km(v) (19 knots, voxels) of the voxels that all shifts of the blocks cover."""
    blocks = np.lib.stride_tricks.sliding_window_view(noisy, (EDGE,) * 3)
    values = np.einsum("zyxkji,ck,bj,ai->cbazyx", blocks, _BASIS, _BASIS, _BASIS, optimize=True)
    by_class = np.zeros((FREQUENCY_CLASSES + 1, len(knots), *(n - 2 * EDGE + 2 for n in noisy.shape)), np.float32)
    for frequency in np.ndindex(CLASSES.shape):
        if any(frequency):
            for m, knot in enumerate(sigma * knots):
                clipped = np.clip(values[frequency], -knot, knot)
                for axis, f in enumerate(frequency):
                    clipped = spread(clipped, _BASIS[f], axis)
                by_class[CLASSES[frequency], m] += clipped / EDGE**3
    return by_class[1:].reshape(FREQUENCY_CLASSES * len(knots), -1)


def spread(values: np.ndarray, wave: np.ndarray, axis: int) -> np.ndarray:
    """Adds a wave from each block's start along an axis, at places that EDGE blocks cover."""
    count = values.shape[axis] - EDGE + 1
    along = np.moveaxis(values, axis, 0)
    return np.moveaxis(sum(wave[i] * along[EDGE - 1 - i : EDGE - 1 - i + count] for i in range(EDGE)), 0, axis)


def normal_equations(cube: np.ndarray, sigma: float, knots: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns the squares and products, per voxel and over σ², of (features, noise): (n + 1, n + 1)."""
    noise = (sigma * rng.standard_normal(cube.shape)).astype(np.float32)
    rows = features(cube + noise, sigma, knots)
    wanted = noise[(slice(EDGE - 1, 1 - EDGE),) * 3].reshape(1, -1)
    rows = np.concatenate([rows, wanted]) / sigma
    return (rows @ rows.T).astype(np.float64) / rows.shape[1]


def solve(systems: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the weights (n,) and each system's error in σ², with systems (S, n + 1, n + 1) relative to their errors."""
    share = np.ones(len(systems))
    for _ in range(ROUNDS):
        whole = np.tensordot(share, systems, 1)
        square, wanted = whole[:-1, :-1], whole[:-1, -1]
        weights = np.linalg.solve(square + RIDGE * np.trace(square) / len(square) * np.eye(len(square)), wanted)
        signed = np.append(-weights, 1)
        errors = np.einsum("i,sij,j->s", signed, systems, signed)
        share = 1 / errors
    return weights, errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--volumes", type=Path, nargs="*", help="HDF5 files instead of procedural volumes")
    parser.add_argument("--cubes", type=int, default=4, help="of a volume, for each noise")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    before_s, rng, knots = time.process_time(), np.random.default_rng(given.seed), np.float32(KNOTS)
    volumes = file_volumes(given.volumes) if given.volumes else procedural_volumes(given.seed)
    systems = np.array([
        normal_equations(cube, sigma, knots, rng)
        for volume in volumes for sigma in NOISES for cube in cubes_of(volume, given.cubes, rng)
    ])  # fmt: skip
    weights, errors = solve(systems)
    curves = weights.reshape(FREQUENCY_CLASSES, -1)
    origin = ", ".join(path.stem for path in given.volumes) if given.volumes else "procedural volumes"
    text = {
        "origin": f"benchmarks/train_curves.py, seed {given.seed}, {origin}", "knots": KNOTS,
        "weights": [[round(float(w), 5) for w in row] for row in curves],
    }
    given.output.write_text(json.dumps(text).replace("[[", "[\n[").replace("], [", "],\n["), encoding="utf-8")
    print(f"{len(systems)} systems, error {np.exp(np.log(errors).mean()):.4f} σ², {time.process_time() - before_s:.0f} s")


if __name__ == "__main__":
    main()
