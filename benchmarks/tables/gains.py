"""What a model of the motion gives a method: its runs less the static ones of the same volumes and seeds."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tables.case import FLY, STILL
from tables.results import Line
from tables.rows import Row
from tables.summary import Summary, lines_of_run, summarise


@dataclass(frozen=True)
class Gain:
    """A row beside its static model on the same fly-scans, and on stop-and-shoot scans where those were run.

    mean_db, least_db and greatest_db are of the volumes' gains in PSNR, each the mean over its seeds.
    """

    static: Summary
    moving: Summary
    still: Summary | None
    mean_db: float
    least_db: float
    greatest_db: float
    volumes: int


def gain_over_static(lines: Sequence[Line], protocol: str, row: Row) -> Gain | None:
    """The gain of a row over its static model under a protocol.

    Only volumes and seeds that were run with both count. None for a static row, and where no such pair was run.
    """
    static_row = row.static()
    if static_row.run == row.run:
        return None
    moving = _by_scan(lines_of_run(lines, protocol, row.run, FLY))
    static = _by_scan(lines_of_run(lines, protocol, static_row.run, FLY))
    both = sorted(set(moving) & set(static))
    static_summary = summarise([static[scan] for scan in both])
    moving_summary = summarise([moving[scan] for scan in both])
    if static_summary is None or moving_summary is None:
        return None
    gains = defaultdict(list)
    for volume, seed in both:
        scan = (volume, seed)
        gains[volume].append(moving[scan]["metrics"]["psnr_db"] - static[scan]["metrics"]["psnr_db"])
    means = [float(np.mean(each)) for each in gains.values()]
    still = _by_scan(lines_of_run(lines, protocol, static_row.run, STILL))
    return Gain(
        static=static_summary,
        moving=moving_summary,
        still=summarise([still[scan] for scan in both if scan in still]),
        mean_db=float(np.mean(means)),
        least_db=min(means),
        greatest_db=max(means),
        volumes=len(means),
    )


def _by_scan(lines: Sequence[Line]) -> dict[tuple[str, int], Line]:
    """Lines by volume and seed; a perfect volume has no number, and no gain either."""
    measured = [line for line in lines if line["metrics"].get("psnr_db") is not None]
    return {(line["volume"], line["seed"]): line for line in measured}
