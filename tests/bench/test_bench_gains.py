"""What a model of the motion gives: pairs of the same volume and seed, and nothing else."""

from __future__ import annotations

from typing import Any

import pytest
from tables import Row, rows_of
from tables.case import FLY, STILL
from tables.gains import gain_over_static

ROWS = {row.label: row for row in rows_of("table1")}
MOVING, STATIC = ROWS["SART per-row"], ROWS["SART"]


def line(row: Row, volume: str, seed: int, psnr_db: float, **others: Any) -> dict[str, Any]:
    """A line of a results file as far as a gain looks at it."""
    facts = {"run": row.run, "protocol": "rapid", "acquisition": FLY, "processor_s": 2.0, **others}
    return {**facts, "volume": volume, "seed": seed, "metrics": {"psnr_db": psnr_db, "ssim": 0.5}}


LINES = [
    *(line(STATIC, *where) for where in (("a", 0, 20.0), ("a", 1, 22.0), ("b", 0, 30.0))),
    *(line(MOVING, *where) for where in (("a", 0, 21.0), ("a", 1, 25.0))),
    line(MOVING, "b", 0, 30.5, processor_s=8.0),
]


def test_a_gain_is_the_mean_over_volumes_of_the_means_over_their_seeds() -> None:
    gain = gain_over_static(LINES, "rapid", MOVING)
    assert gain is not None
    assert (gain.least_db, gain.greatest_db) == (0.5, 2.0)
    assert gain.mean_db == pytest.approx(1.25)
    assert gain.mean_db == pytest.approx(gain.moving.mean["psnr_db"] - gain.static.mean["psnr_db"])
    assert gain.moving.mean["processor_s"] == 5.0
    assert (gain.volumes, gain.still) == (2, None)


def test_scans_without_a_partner_and_perfect_volumes_do_not_count() -> None:
    gain = gain_over_static(LINES, "rapid", MOVING)
    alone = [line(STATIC, "c", 0, 90.0), line(MOVING, "a", 2, 90.0), line(MOVING, "d", 0, 90.0)]
    for more in (alone, [line(MOVING, "a", 0, 90.0, protocol="standard")]):
        assert gain_over_static([*LINES, *more], "rapid", MOVING) == gain
    assert gain_over_static([line(STATIC, "a", 0, 20.0), line(MOVING, "a", 1, 21.0)], "rapid", MOVING) is None
    assert gain_over_static(LINES, "rapid", ROWS["CGLS per-row"]) is None
    perfect = {**line(MOVING, "b", 0, 0.0), "metrics": {"psnr_db": None, "ssim": 1.0}}
    gain = gain_over_static([*LINES[:5], perfect], "rapid", MOVING)
    assert gain is not None and (gain.volumes, gain.mean_db) == (1, 2.0)


def test_a_static_row_has_no_gain_and_stop_and_shoot_is_of_the_same_scans() -> None:
    assert gain_over_static(LINES, "rapid", STATIC) is None
    still = [line(STATIC, volume, 0, psnr, acquisition=STILL) for volume, psnr in (("a", 40.0), ("c", 90.0))]
    gain = gain_over_static([*LINES, *still], "rapid", MOVING)
    assert gain is not None and gain.still is not None
    assert gain.still.mean["psnr_db"] == 40.0
