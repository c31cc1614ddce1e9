"""Options of density control and learning rates: published numbers, and when control acts."""

import numpy as np

from phyradgs_cl.optim import PUBLISHED_RATES, DensityControl, Rates


def test_published_numbers() -> None:
    """Rates and rounds of R2-Gaussian's and PhyRadGS' published settings, and our own defaults beside them."""
    assert Rates((2e-4, 2e-5), (5e-3, 5e-4), (1e-3, 1e-4), (1e-2, 1e-3)) == PUBLISHED_RATES
    assert Rates() == Rates((2e-3, 2e-4), (2e-2, 2e-3), (1e-2, 1e-3), (6e-2, 6e-3))
    control = DensityControl()
    assert (control.every, control.start_iteration, control.stop_fraction) == (100, 500, 0.75)
    assert (control.threshold, control.split_scale, control.split_factor) == (3e-4, 0.2, 1.6)
    assert (control.prune_density, control.prune_aspect, control.max_gaussians) == (1e-5, 50.0, 500_000)


def test_edges_of_control() -> None:
    scale = np.array([[1.0, 1.0, 2.0], [1.0, 1.0, 1.0], [1.0, 0.999, 1.0]])
    for aspect, allowed in {1.0: [True, False, False], 2.0: [True] * 3, 0.0: [True] * 3}.items():
        assert DensityControl(prune_aspect=aspect).allows(scale).tolist() == allowed
