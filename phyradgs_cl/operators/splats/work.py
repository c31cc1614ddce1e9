"""The work of a splat projector's launch: pairs of Gaussian and pixel, and the rules used to average over time.

Computed from the records of cl/common/splat.h, which counts the iterations of cl/splat_forward.cl without running it."""

from dataclasses import dataclass, field

import numpy as np

_U_REST, _V_REST, _U_WHOLE, _V_WHOLE, _U_LO, _U_HI, _V_LO, _V_HI = 3, 4, 9, 10, 11, 12, 13, 14
_ALONG_U, _ALONG_V, _ACROSS_V, _ACROSS_U, _SPEED, _REACH2 = 0, 1, 2, 15, 16, 17
UNSEEN = np.zeros(20, np.float32)  # a record without lines, for splats that are not visible
UNSEEN.view(np.int32)[[_V_LO, _V_HI]] = 1, 0
RULES = ("1 time", "2 times", "3 times", "closed form")


@dataclass(frozen=True)
class Work:
    """``pairs`` of Gaussian and pixel; ``evaluated`` pairs, in complete vectors; ``footprints``, Gaussians in cells.

    ``rules``: the pairs by rule of ``RULES``, for cells with motion."""

    pairs: int
    evaluated: int
    footprints: int
    rules: dict[str, int] = field(default_factory=dict)

    def rule_shares(self) -> dict[str, float]:
        """Returns each rule's share of the pairs; empty without motion."""
        return {name: count / max(self.pairs, 1) for name, count in self.rules.items()}


def still_work(records: np.ndarray, lanes: int) -> Work:
    """Counts the work of records (G, C, 16) float32: the pixels of bounding boxes, line by line."""
    whole = records.view(np.int32)
    rows = np.maximum(whole[..., _V_HI].astype(np.int64) - whole[..., _V_LO] + 1, 0)
    columns = np.where(rows > 0, whole[..., _U_HI].astype(np.int64) - whole[..., _U_LO] + 1, 0)
    vectors = (columns + lanes - 1) // lanes * lanes
    return Work(int((rows * columns).sum()), int((rows * vectors).sum()), int((rows > 0).sum()))


def moving_work(
    records: np.ndarray, times: np.ndarray, path_limits: np.ndarray, lanes: int, cuts: bool
) -> Work:
    """Counts the work of records (G, C, 20), with ``TimeCells.line_times`` (C, 3, at least lines), both float32."""
    pairs, evaluated, footprints, rules = 0, 0, 0, np.zeros(len(RULES), np.int64)
    for cell in range(records.shape[1]):
        record = np.ascontiguousarray(records[:, cell])
        record = record[record.view(np.int32)[:, _V_HI] >= record.view(np.int32)[:, _V_LO]]
        splat, line = _lines_of(record.view(np.int32))
        columns = _span(record[splat], line, times[cell], cuts)
        path = 2 * record[splat, _SPEED] * times[cell, 1, line]
        rule = np.searchsorted(path_limits[:3], path)
        pairs += int(columns.sum())
        evaluated += int(((columns + lanes - 1) // lanes * lanes).sum())
        footprints += len(record)
        rules += np.bincount(rule, columns, len(RULES)).astype(np.int64)
    return Work(pairs, evaluated, footprints, dict(zip(RULES, rules.tolist(), strict=True)))


def _lines_of(whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the splat and the line of every line of every splat, both (splat lines,)."""
    rows = (whole[:, _V_HI] - whole[:, _V_LO] + 1).astype(np.int64)
    splat = np.repeat(np.arange(len(whole)), rows)
    within = np.arange(rows.sum()) - np.repeat(np.cumsum(rows) - rows, rows)
    return splat, whole[splat, _V_LO] + within


def _span(record: np.ndarray, line: np.ndarray, times: np.ndarray, cuts: bool) -> np.ndarray:
    """Returns the number of pixels (splat lines,) that ``moving_span`` of cl/common/splat_moving.h selects."""
    whole = record.view(np.int32)
    with np.errstate(invalid="ignore"):  # integers read as floats
        wide = record.astype(np.float64)
    middle, half, weight = times[:, line].astype(np.float64)
    lo, hi = whole[:, _U_LO].astype(np.int64), whole[:, _U_HI].astype(np.int64)
    if cuts:
        dv = line - whole[:, _V_WHOLE] - wide[:, _V_REST]
        first, last = _stadium(wide, dv, (middle - half) * wide[:, _SPEED], (middle + half) * wide[:, _SPEED])
        centre = whole[:, _U_WHOLE] + wide[:, _U_REST]
        lo = np.maximum(lo, np.ceil(centre + first - 0.01).clip(-4e6, 4e6).astype(np.int64))
        hi = np.minimum(hi, np.floor(centre + last + 0.01).clip(-4e6, 4e6).astype(np.int64))
    return np.where(weight > 0, np.maximum(hi - lo + 1, 0), 0)


def _stadium(
    wide: np.ndarray, dv: np.ndarray, start: np.ndarray, stop: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns where lines enter and leave the region swept by a disc: the discs at both ends, and the sides between."""
    a1, c1, reach = wide[:, _ALONG_U], wide[:, _ACROSS_U], np.sqrt(wide[:, _REACH2])
    a0, c0 = wide[:, _ALONG_V] * dv, wide[:, _ACROSS_V] * dv
    norm = a1 * a1 + c1 * c1
    found = []
    for end in (start, stop):
        left = reach**2 * norm - (a1 * c0 - c1 * (a0 - end)) ** 2
        for sign in (-1, 1):
            at = (-(a1 * (a0 - end) + c1 * c0) + sign * np.sqrt(np.maximum(left, 0))) / norm
            found.append(np.where(left >= 0, at, np.nan))
    steep = np.where(np.abs(c1) > 1e-12, c1, 1e-12)
    for sign in (-1, 1):
        at = (sign * reach - c0) / steep
        along = a1 * at + a0
        found.append(np.where((along >= start) & (along <= stop), at, np.nan))
    ends = np.stack(found)
    return np.fmin.reduce(ends, initial=1e9), np.fmax.reduce(ends, initial=-1e9)
