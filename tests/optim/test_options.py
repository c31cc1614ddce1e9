"""Options of density control and learning rates: published numbers, ranges with both ends, values that stay."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.optim import DensityControl, Rates
from phyradgs_cl.optim.adam import PUBLISHED_RATES

# what the command line accepts (docs/reference/cli.md says the defaults)
RANGES = {
    "every": (0, 1_000_000_000), "start_iteration": (0, 1_000_000_000), "stop_fraction": (0, 1),
    "threshold": (0, 1e6),
    "split_scale": (0, 1e3), "split_factor": (1, 1e3), "prune_density": (0, 1e6), "prune_aspect": (0, 1e9),
    "max_gaussians": (1, 100_000_000),
}  # fmt: skip


def test_ranges_of_density_control_hold_both_ends() -> None:
    for name, (lowest, highest) in RANGES.items():
        for inside in (lowest, highest):
            assert getattr(replace(DensityControl(), **{name: inside}), name) == inside
        for outside in (lowest - 0.5, highest * 1.001, float("nan")):
            with pytest.raises(InputError, match=f"control.{name}"):
                replace(DensityControl(), **{name: outside})


def test_rates_hold_both_ends() -> None:
    for name in ("position", "scale", "rotation", "density"):
        for first, last in ((1e-12, 10), (10, 1e-12)):
            assert getattr(replace(Rates(), **{name: (first, last)}), name) == (first, last)
        for first, last in ((0.9e-12, 1), (1, 0.9e-12), (10.01, 1), (1, 0.0)):
            with pytest.raises(InputError, match=f"rates.{name}"):
                replace(Rates(), **{name: (first, last)})


def test_published_numbers() -> None:
    """Rates and rounds of R2-Gaussian's and PhyRadGS' published settings, and our own defaults beside them."""
    assert Rates((2e-4, 2e-5), (5e-3, 5e-4), (1e-3, 1e-4), (1e-2, 1e-3)) == PUBLISHED_RATES
    assert Rates() == Rates((2e-3, 2e-4), (2e-2, 2e-3), (1e-2, 1e-3), (6e-2, 6e-3))
    control = DensityControl()
    assert (control.every, control.start_iteration, control.stop_fraction) == (100, 500, 0.75)
    assert (control.threshold, control.split_scale, control.split_factor) == (3e-4, 0.2, 1.6)
    assert (control.prune_density, control.prune_aspect, control.max_gaussians) == (1e-5, 50.0, 500_000)


@pytest.mark.parametrize("options", [DensityControl(), Rates()])
def test_options_are_values(options) -> None:
    with pytest.raises(FrozenInstanceError):
        options.every = options.position = 1
    assert options == replace(options) and hash(options) == hash(replace(options))


def test_edges_of_control() -> None:
    scale = np.array([[1.0, 1.0, 2.0], [1.0, 1.0, 1.0], [1.0, 0.999, 1.0]])
    for aspect, allowed in {1.0: [True, False, False], 2.0: [True] * 3, 0.0: [True] * 3}.items():
        assert DensityControl(prune_aspect=aspect).allows(scale).tolist() == allowed
    control = DensityControl(every=1, start_iteration=2, stop_fraction=0.5)
    assert [i for i in range(1, 21) if control.is_due(i, 20)] == list(range(3, 10))
