"""What every method returns, and how it reports on the way."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from phyradgs_cl.acquisition.motion import motion_facts
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gaussians, Grid

State = Mapping[str, np.ndarray]
"""What an interrupted run needs to go on, as named arrays: each method knows its own names."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A volume (nz, ny, nx) float32 in 1/mm on ``grid``.

    gaussians: the cloud in mm, for methods that have one; record: the convergence record, one dict per report;
    facts: what is needed to make it again (method, options, scales, seconds); state: how to go on, where a run
    was interrupted.
    """

    volume: np.ndarray
    grid: Grid
    gaussians: Gaussians | None = None
    record: list[dict[str, float]] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)
    state: State | None = None


@dataclass(frozen=True)
class Progress:
    """One report of a running method: ``loss`` is what ``quantity`` names; 0 Gaussians where there are none.

    ``state`` makes what a run needs to go on from here, ``volume`` the present volume (nz, ny, nx) in 1/mm with its grid;
    both are for the time of the report only.
    """

    iteration: int
    iterations: int
    loss: float
    gaussians: int
    seconds: float
    quantity: str = "loss"
    state: Callable[[], State] | None = None
    volume: Callable[[], tuple[np.ndarray, Grid]] | None = None


ProgressReport = Callable[[Progress], None]


def ignore_progress(progress: Progress) -> None:
    """The default report: none."""


def option_facts(options: Any) -> dict[str, object]:
    """A method's options for the facts of its result."""
    return {**asdict(options), "motion": motion_facts(options.motion)}


def state_arrays(state: State, names: Sequence[str]) -> list[np.ndarray]:
    """The arrays of an interrupted run by name; raises InputError for a state that lacks one."""
    missing = sorted(set(names) - set(state))
    if missing:
        raise InputError(
            "checkpoint", f"no {', '.join(missing)}", "a whole checkpoint", "start without --resume"
        )
    return [state[name] for name in names]


def history_arrays(record: Sequence[Mapping[str, float]], seconds: float) -> dict[str, np.ndarray]:
    """A convergence record and the seconds so far as entries of a state."""
    return {"record": np.array(json.dumps(list(record))), "seconds": np.array(seconds)}
