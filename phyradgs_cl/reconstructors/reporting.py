"""Reports under several ranks: rank 0 alone makes them, and the others make what it needs along with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from phyradgs_cl.parallel import Communicator
from phyradgs_cl.reconstructors.result import Progress, ProgressReport

Made = TypeVar("Made")
_GO_ON, _STOP = "go on", "stop"


def report_once(ranks: Communicator, report: ProgressReport, progress: Progress) -> bool:
    """Calls ``report`` on rank 0; whether it asks all to stop, by KeyboardInterrupt.

    A state or a volume that it asks for is made on all ranks, whose part in it may be needed.
    """
    makers = {"state": progress.state, "volume": progress.volume}
    if ranks.rank > 0:
        while (word := ranks.tell(None)) in makers:
            makers[word]()  # type: ignore[misc]
        return word == _STOP

    def on_all(name: str, make: Callable[[], Made] | None) -> Callable[[], Made] | None:
        def made() -> Made:
            ranks.tell(name)
            return make()  # type: ignore[misc]

        return None if make is None else made

    stop = False
    try:
        state, volume = on_all("state", progress.state), on_all("volume", progress.volume)
        report(replace(progress, state=state, volume=volume))
    except KeyboardInterrupt:
        stop = True
    ranks.tell(_STOP if stop else _GO_ON)
    return stop
