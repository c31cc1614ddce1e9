"""Radiative Gaussians: their parameters with units, and the unconstrained ("raw") numbers that the optimiser changes.

The field of a Gaussian of density ρ, mean μ and scale s is ρ exp(−½ (x−μ)ᵀ Σ⁻¹ (x−μ)), Σ = R diag(s²) Rᵀ, R its rotation."""

from dataclasses import dataclass

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError

ROWS = 11  # numbers of a Gaussian: mean 3, scale 3, quaternion 4, density 1
MEAN, SCALE, QUATERNION, DENSITY = slice(0, 3), slice(3, 6), slice(6, 10), 10
_DENSITY_FLOOR = 1e-12  # least density of a Gaussian, so that its raw number is finite


@dataclass(frozen=True, eq=False)
class Gaussians:
    """A cloud of G Gaussians.

    mean (G, 3), x y z, and scale (G, 3): in the same unit of length, mm except within reconstruction methods. quaternion (G,
    4): w x y z, of any length above 0. density (G,): attenuation per unit of length. Raises InputError for other shapes,
    infinite values or NaN, scales that are not above 0, and quaternions of length 0."""

    mean: np.ndarray
    scale: np.ndarray
    quaternion: np.ndarray
    density: np.ndarray

    def __post_init__(self) -> None:
        count = len(np.atleast_1d(checks.real_array("Gaussians' mean", self.mean)))
        shapes = {"mean": (count, 3), "scale": (count, 3), "quaternion": (count, 4), "density": (count,)}
        for name, shape in shapes.items():
            checks.numbers(f"Gaussians' {name}", getattr(self, name), shape)
            object.__setattr__(self, name, np.asarray(getattr(self, name)))
        if (self.scale <= 0).any():
            raise InputError("Gaussians' scale", f"{self.scale.min():g}", "lengths above 0", "of logarithms: np.exp(scale)")
        if not self.quaternion.any(axis=1).all():
            raise InputError("Gaussians' quaternion", "0, 0, 0, 0", "a rotation", "of none: 1, 0, 0, 0")

    def __repr__(self) -> str:
        return f"Gaussians({self.count} of them)"

    @property
    def count(self) -> int:
        """The number of Gaussians G."""
        return len(self.mean)

    def rows(self) -> np.ndarray:
        """Returns the parameters (11, G) float64, in the order that kernels read: mean, scale, unit quaternion, density."""
        q = self.quaternion
        if self.count:
            q = np.ldexp(q, -np.frexp(np.abs(q).max(axis=1, keepdims=True))[1])  # exact scaling: no square is 0 or infinite
            q = q / np.linalg.norm(q, axis=1, keepdims=True)
        return np.concatenate([self.mean.T, self.scale.T, q.T, self.density[None]]).astype(np.float64)

    @classmethod
    def from_rows(cls, rows: np.ndarray) -> "Gaussians":
        """Makes a cloud from parameter rows (11, G), in the order of ``rows``. Raises InputError for another shape."""
        rows = checks.numbers("rows", rows, (11, None))
        return cls(rows[MEAN].T.copy(), rows[SCALE].T.copy(), rows[QUATERNION].T.copy(), rows[DENSITY].copy())

    @classmethod
    def of_covariance(cls, mean: np.ndarray, covariance: np.ndarray, density: np.ndarray) -> "Gaussians":
        """Makes a cloud from means (G, 3), covariances (G, 3, 3) and densities (G,). Raises InputError for other shapes, and
        for a covariance that is not positive definite."""
        count = len(np.atleast_1d(checks.real_array("Gaussians' mean", mean)))
        variance, axes = np.linalg.eigh(checks.numbers("covariance", covariance, (count, 3, 3)))
        axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # flips an axis of a reflection, so that it is a rotation
        x, y, z, w = scipy.spatial.transform.Rotation.from_matrix(axes).as_quat().T
        return cls(mean, np.sqrt(variance), np.stack([w, x, y, z], -1), density)

    def scaled(self, length: float, density: float) -> "Gaussians":
        """Returns the cloud with lengths multiplied by ``length`` and densities by ``density``."""
        return Gaussians(self.mean * length, self.scale * length, self.quaternion, self.density * density)


@dataclass(frozen=True)
class Activation:
    """Maps raw numbers x to parameters: scale = min + (max − min) sigmoid(x), density = softplus(x), quaternion = x/|x|.
    The mean is its own raw number."""

    scale_min: float
    scale_max: float

    def apply(self, raw: np.ndarray) -> np.ndarray:
        """Returns parameter rows (11, G) for raw rows (11, G). This is the float64 twin of ``activate`` in cl/adam.cl."""
        rows = np.array(raw, dtype=np.float64)
        rows[SCALE] = self.scale_min + (self.scale_max - self.scale_min) * scipy.special.expit(raw[SCALE])
        rows[QUATERNION] = raw[QUATERNION] / np.linalg.norm(raw[QUATERNION], axis=0)
        rows[DENSITY] = np.maximum(np.logaddexp(0.0, raw[DENSITY]), _DENSITY_FLOOR)
        return rows

    def invert(self, rows: np.ndarray) -> np.ndarray:
        """Returns raw rows for parameter rows (11, G). The inverse is infinite at the bounds. So scales are first moved 1e-4
        of their range inside their bounds, and densities are raised to at least 1e-12."""
        raw = np.array(rows, dtype=np.float64)
        span = self.scale_max - self.scale_min
        raw[SCALE] = scipy.special.logit(np.clip((rows[SCALE] - self.scale_min) / span, 1e-4, 1 - 1e-4))
        density = np.maximum(rows[DENSITY], _DENSITY_FLOOR)
        raw[DENSITY] = density + np.log(-np.expm1(-density))
        return raw
