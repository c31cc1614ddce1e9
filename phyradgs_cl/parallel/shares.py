"""Who does what: counts divided over ranks, and the frames of a batch over ranks or, where there are more, teams."""

from __future__ import annotations

from dataclasses import dataclass

from phyradgs_cl.parallel.communicator import Alone, Communicator


def span(count: int, parts: int, part: int) -> range:
    """The ``part``-th of ``parts`` runs of 0 … count−1, whose lengths differ by one at most."""
    return range(part * count // parts, (part + 1) * count // parts)


@dataclass(frozen=True)
class Shares:
    """What one rank does of a batch: whole frames (by their place in it), or a part of the lines of one frame.

    ``team``: the ranks that have a part of the same frame, of which this one has the ``team.rank``-th.
    """

    places: tuple[int, ...]
    team: Communicator

    @classmethod
    def of(cls, ranks: Communicator, frames: int) -> Shares:
        """Frames go round; with more ranks than frames, rank r is in the team of frame r modulo the frames."""
        if ranks.size <= frames:
            return cls(tuple(range(ranks.rank, frames, ranks.size)), Alone())
        place = ranks.rank % frames
        return cls((place,), ranks.team(place) if frames > 1 else ranks)
