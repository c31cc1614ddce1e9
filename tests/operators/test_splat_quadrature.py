"""The float64 twin of the exact splat against numerical integration along rays, which knows no closed form."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tolerances import TWIN_QUADRATURE

from phyradgs_cl.acquisition import pixel_centres
from phyradgs_cl.operators.twins.splat import splat_image

PANELS, ORDER, REACH_SIGMA = 400, 10, 12.0


def density_at(row: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The field (n,) of one Gaussian (11,) at points (n, 3), from the definition."""
    w, x, y, z = row[6:10] / np.linalg.norm(row[6:10])
    local = Rotation.from_quat([x, y, z, w]).inv().apply(points - row[:3]) / row[3:6]
    return row[10] * np.exp(-0.5 * (local**2).sum(-1))


def integrate(row: np.ndarray, source: np.ndarray, target: np.ndarray) -> float:
    """The field along the line through source and target, by Gauss–Legendre in panels."""
    direction = (target - source) / np.linalg.norm(target - source)
    middle = direction @ (row[:3] - source)
    reach = REACH_SIGMA * row[3:6].max()
    edges = np.linspace(middle - reach, middle + reach, PANELS + 1)
    node, weight = np.polynomial.legendre.leggauss(ORDER)
    half = np.diff(edges)[:, None] / 2
    at = (edges[:-1, None] + half * (1 + node)).ravel()
    return float((half * weight).ravel() @ density_at(row, source + at[:, None] * direction))


@pytest.mark.parametrize("seed", range(6))
def test_twin_is_the_line_integral(make_cloud, make_geometry, seed) -> None:
    rows = make_cloud(1, seed, scale=(0.06, 0.3))
    geometry = make_geometry(24, 28, offset=(0.2, -0.3))
    pose = geometry.pose(0.7 * seed)
    image = splat_image(rows, pose, (24, 28))
    pixels = pixel_centres(pose, (24, 28))
    chosen = [(v, u) for v in range(1, 24, 4) for u in range(2, 28, 4)]
    chosen.append(tuple(np.unravel_index(image.argmax(), image.shape)))
    expected = [integrate(rows[:, 0], pose[:3], pixels[at]) for at in chosen]
    found = [image[at] for at in chosen]
    np.testing.assert_allclose(found, expected, rtol=0, atol=TWIN_QUADRATURE * image.max())
