"""A run as one value: its method, options, preprocessing, seed and first volume. The command line, configuration files, the
API, sweeps and watched folders all make it with ``plan_run``."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.frames.preprocess import Preprocessing
from phyradgs_cl.reconstructors.options import method_options, preprocessing_names, preprocessing_of
from phyradgs_cl.reconstructors.registry import DEFAULT_METHOD, method_name

LARGEST_SEED = 2**63


@dataclass(frozen=True, eq=False)
class InitialVolume:
    """A volume (nz, ny, nx) in 1/mm from which a method starts, and its grid. facts: which file holds it, for provenance."""

    values: np.ndarray
    grid: Grid
    facts: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RunPlan:
    """What to run on a scan. method: a name as from ``method_name``, or a function of the user's own. options: the method's,
    checked. preprocessing: what happens to the frames first. Raises InputError for a seed out of range."""

    method: "str | Callable[..., Any]"
    options: Any
    preprocessing: Preprocessing = Preprocessing()
    seed: int = 0
    initial: InitialVolume | None = None

    def __post_init__(self) -> None:
        checks.whole("--seed", self.seed, 0, LARGEST_SEED)

    @property
    def method_name(self) -> str:
        """The method's name; of a function ``module:name``."""
        return method_name(self.method)


def plan_run(
    method: object = DEFAULT_METHOD,
    values: Mapping[str, Any] | None = None,
    *,
    preset: str | None = None,
    seed: int = 0,
    initial: InitialVolume | None = None,
    of_preprocessing: Collection[str] = (),
) -> RunPlan:
    """Returns the plan of a run: ``values`` by name over the method's preset.

    A name that both the method and the preprocessing have is the method's, except those in ``of_preprocessing``.
    Raises InputError for a method, preset, option or value that does not exist.
    """
    own = dict(values or {})
    names = [*preprocessing_names(method, preset), *of_preprocessing]
    preprocessing = preprocessing_of({name: own.pop(name) for name in names if name in own})
    options = method_options(method, preset, own, preprocessing.tune)
    checks.whole("--seed", seed, 0, LARGEST_SEED)
    return RunPlan(method if callable(method) else method_name(method), options, preprocessing, int(seed), initial)
