"""Trains the numbers of the prior ``ridge``: one step of a weakly convex ridge regulariser, with the least error.

    python benchmarks/train_ridge.py data/ridge.json

The step takes G(v) = Wᵀ g(W v) from a volume v (Goujon, Neumayer and Unser, SIAM J. Imaging Sci. 17 (2024) 91). W is two
convolutions of 3³ voxels, from 1 to 4 to 16 channels, whose product has zero mean. At noise of deviation σ
g_i(t) = a_i clip(t, ± σ k_i) − b_i clip(t, ± σ l_i). Σ b_i |Ŵ_i|² ≤ 1 at all frequencies, so the regulariser plus ½‖x‖² is
convex. Every cube counts by the logarithm of its squared error. The noise is smooth, as on the smaller voxels of ``fista``,
which the pixels do not resolve.

Cubes come from procedural volumes that this script draws, and from phantoms: solids with texture, foams, vessels, foot, jaw.
Needs PyTorch, which the extra ``neural`` installs."""

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import scipy
import torch

from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics.align import block_means
from phyradgs_cl.phantoms import make_phantom

NOISES = (0.008, 0.016, 0.03, 0.05)  # σ over a volume's range
CUBE = 32  # voxels per side
DRAWN = 128  # voxels per side of procedural volumes, before means of 2³
MIDDLE, FILTERS = 4, 16  # channels of the two convolutions
TAPS = 3  # along an axis, in either convolution
RIM = 2 * (TAPS - 1)  # voxels at a cube's faces that lack some filters
FREQUENCIES = 16, 48  # along an axis, where the gains of filters are computed: in training, and for the file
NOISE_WIDTH = 0.8  # standard deviation, in voxels, of the Gaussian that smooths the noise
MARGIN = 0.97  # fraction of b in the file, so that rounding and more frequencies keep the bound
BATCH, RATE = 8, 0.01  # cubes of a step, and Adam's first rate


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


class Ridge(torch.nn.Module):
    """The map v → v − G(v) of cubes (n, 1, CUBE, CUBE, CUBE), inside the rim."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        draw = torch.Generator().manual_seed(seed)
        self.first = torch.nn.Parameter(torch.randn(MIDDLE, 1, TAPS, TAPS, TAPS, generator=draw) / 5)
        self.second = torch.nn.Parameter(torch.randn(FILTERS, MIDDLE, TAPS, TAPS, TAPS, generator=draw) / 10)
        self.log_slopes = torch.nn.Parameter(torch.tensor([[1.0], [0.5]]).log().repeat(1, FILTERS))
        knots = torch.tensor([[1.0], [3.0]]) * torch.linspace(0.5, 1.5, FILTERS)
        self.log_knots = torch.nn.Parameter(knots.log())

    def numbers(self) -> dict[str, torch.Tensor]:
        """Returns the numbers of the file: filters of zero mean, and slopes within the bound."""
        sums = self.first.sum((1, 2, 3, 4))
        along = self.second.sum((2, 3, 4)) @ sums / (sums @ sums)
        second = self.second - along[:, None, None, None, None] * sums[:, None, None, None] / TAPS**3
        slopes, knots = self.log_slopes.exp(), self.log_knots.exp()
        down = slopes[1] / bound(gains(self.first, second, FREQUENCIES[0]), slopes[1]).clamp(min=1)
        curves = {"slope_up": slopes[0], "knot_up": knots[0], "slope_down": down, "knot_down": knots[1]}
        return {"first": self.first, "second": second, **curves}

    def forward(self, volumes: torch.Tensor, sigma: torch.Tensor) -> torch.Tensor:
        numbers, conv = self.numbers(), torch.nn.functional.conv3d
        first, second = numbers["first"], numbers["second"]
        responses = conv(conv(volumes, first), second)
        forces = []
        for way in ("up", "down"):
            slope, knot = (numbers[f"{kind}_{way}"][:, None, None, None] for kind in ("slope", "knot"))
            forces.append(slope * torch.maximum(torch.minimum(responses, sigma * knot), -sigma * knot))
        taken = conv(conv(forces[0] - forces[1], transposed(second)), transposed(first))
        return inside(volumes) - taken


def inside(volumes: torch.Tensor) -> torch.Tensor:
    return volumes[(..., *[slice(RIM, -RIM)] * 3)]


def transposed(filters: torch.Tensor) -> torch.Tensor:
    """Returns the filters of the transposed convolution."""
    return filters.transpose(0, 1).flip(2, 3, 4)


def gains(first: torch.Tensor, second: torch.Tensor, count: int) -> torch.Tensor:
    """Returns |Ŵ_i|² (FILTERS, frequencies) at ``count`` frequencies along each axis."""
    by_first, by_second = (torch.fft.rfftn(filters, (count,) * 3, (2, 3, 4)) for filters in (first, second))
    return torch.einsum("cozyx,iczyx->izyx", by_first, by_second).abs().square().flatten(1)


def bound(gain: torch.Tensor, slopes: torch.Tensor) -> torch.Tensor:
    """Returns the largest Σ slope_i |Ŵ_i|²."""
    return (slopes @ gain).max()


def train(ridge: Ridge, cubes: torch.Tensor, steps: int, draw: torch.Generator) -> None:
    """Minimises the mean logarithm of squared errors by Adam, whose rate falls along half a cosine."""
    optimiser = torch.optim.Adam(ridge.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    low, high = np.log(NOISES[0]), np.log(NOISES[-1])
    for step in range(steps):
        batch = cubes[torch.randint(len(cubes), (BATCH,), generator=draw)]
        batch = batch.permute(0, 1, *(2 + torch.randperm(3, generator=draw)).tolist())
        sigma = torch.exp(low + (high - low) * torch.rand(BATCH, 1, 1, 1, 1, generator=draw))
        loss = errors(ridge, batch, sigma, draw).log().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if step % 100 == 99:
            print(step + 1, f"{loss.item():.3f}", flush=True)


def errors(ridge: Ridge, cubes: torch.Tensor, sigma: torch.Tensor, draw: torch.Generator) -> torch.Tensor:
    """Returns the mean square errors of cubes with noise, over σ²."""
    noisy = cubes + sigma * smooth_noise(cubes.shape, draw)
    return ((ridge(noisy, sigma) - inside(cubes)) / sigma).square().mean((1, 2, 3, 4))


def smooth_noise(shape: torch.Size, draw: torch.Generator) -> torch.Tensor:
    """Returns periodic noise of deviation 1."""
    along = torch.exp(-2 * (torch.pi * NOISE_WIDTH * torch.fft.fftfreq(CUBE)) ** 2)
    spectrum = torch.fft.rfftn(torch.randn(shape, generator=draw), dim=(2, 3, 4))
    spectrum *= along[:, None, None] * along[:, None] * along[: CUBE // 2 + 1]
    smooth = torch.fft.irfftn(spectrum, (CUBE,) * 3, dim=(2, 3, 4))
    return smooth / smooth.std()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--cubes", type=int, default=24, help="of a volume")
    parser.add_argument("--sets", type=int, default=2, help="of procedural volumes")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    before_s, rng = time.process_time(), np.random.default_rng(given.seed)
    torch.set_num_threads(1)
    draw = torch.Generator().manual_seed(given.seed)
    sets = [procedural_volumes(seed) for seed in range(given.seed, given.seed + given.sets)]
    drawn = [cube for volumes in sets for volume in volumes for cube in cubes_of(volume, given.cubes, rng)]
    cubes = torch.from_numpy(np.array(drawn, np.float32))[:, None]
    print(f"{len(cubes)} cubes, {time.process_time() - before_s:.0f} s", flush=True)
    ridge = Ridge(given.seed)
    train(ridge, cubes, given.steps, draw)
    write(given.output, ridge, f"benchmarks/train_ridge.py, seed {given.seed}, procedural volumes")
    with torch.no_grad():
        for noise in NOISES:
            left = errors(ridge, cubes[::10], torch.full((len(cubes[::10]), 1, 1, 1, 1), noise), draw)
            print(f"noise {noise}: error {left.log().mean().exp():.4f} σ²")
    print(f"{time.process_time() - before_s:.0f} s")


def write(path: Path, ridge: Ridge, origin: str) -> None:
    """Writes the numbers in thousandths, with bounds of the regulariser's curvature from above and below."""
    with torch.no_grad():
        numbers = ridge.numbers()
        numbers["slope_down"] = MARGIN * numbers["slope_down"]
        gain = gains(numbers["first"], numbers["second"], FREQUENCIES[1])
        largest = torch.maximum(numbers["slope_up"], numbers["slope_down"])
        bounds = {"lipschitz": bound(gain, largest), "convexity": bound(gain, numbers["slope_down"])}
    text = {"trained_on": origin} | {name: round(float(value), 5) for name, value in bounds.items()}
    text |= {name: np.rint(1000 * values.detach().numpy()).astype(int).ravel().tolist() for name, values in numbers.items()}
    path.write_text(json.dumps(text, separators=(",", ":")), encoding="utf-8")


if __name__ == "__main__":
    main()
