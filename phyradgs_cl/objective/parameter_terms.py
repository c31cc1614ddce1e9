"""Terms of the objective that need no image: density L1 (paper, L_reg) and the released code's shape term."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.fields import gaussians as g


@dataclass(frozen=True)
class ParameterTerms:
    """Weights of the mean density and of mean relu(longest/shortest − ratio)² + mean relu(floor − shortest)².

    ``shape_floor`` is in half-sides of the volume.
    """

    density_weight: float = 0.001
    shape_weight: float = 0.0
    shape_ratio: float = 10.0
    shape_floor: float = 0.004


def parameter_loss(rows: np.ndarray, terms: ParameterTerms) -> tuple[float, np.ndarray]:
    """Float64 twin of the terms in ``chain_activations``: the value and its gradient by rows (11, G)."""
    count = rows.shape[1]
    gradient = np.zeros_like(rows)
    if count == 0:
        return 0.0, gradient
    scale = rows[g.SCALE]
    longest, shortest = scale.max(0), scale.min(0)
    excess = np.maximum(longest / shortest - terms.shape_ratio, 0)
    lack = np.maximum(terms.shape_floor - shortest, 0)
    value = terms.density_weight * rows[g.DENSITY].mean() + terms.shape_weight * (excess**2 + lack**2).mean()
    gradient[g.DENSITY] = terms.density_weight / count
    each = 2 * terms.shape_weight / count
    gradient[g.SCALE] += np.where(scale == longest, each * excess / shortest, 0)
    gradient[g.SCALE] -= np.where(scale == shortest, each * (excess * longest / shortest**2 + lack), 0)
    return float(value), gradient
