"""The answers of a check: a verdict on each question, with the number on which it rests."""

from dataclasses import asdict, dataclass

import numpy as np

OK, SUSPICIOUS, CANNOT_TELL = "ok", "suspicious", "cannot tell"
PIXEL_SIZES = "x_pixel_size and y_pixel_size (--pixel-size-mm of import)"
MIRROR_U, MIRROR_V = "--column-0 (left or right)", "--row-0 (top or bottom)"  # options of import that mirror frames
FEWEST_COLUMNS = 8  # panels with fewer columns are not judged: four columns gave wrong findings, five did not


@dataclass(frozen=True)
class Finding:
    """The answer to one ``question``, with the ``verdict`` "ok", "suspicious" or "cannot tell".

    value: the measured number, in ``unit``. uncertainty: the standard deviation of an estimated value. threshold: the limit
    with which the value is compared. text: what was found. advice: what to do about it."""

    question: str
    verdict: str
    value: float
    threshold: float
    unit: str
    text: str
    advice: str = ""
    uncertainty: float | None = None

    def facts(self) -> dict[str, object]:
        return asdict(self)


def outer_median(p: np.ndarray, valid: np.ndarray) -> float:
    """Returns the median of the ``valid`` pixels in the outermost columns of p (F, v, u), or in all columns without one."""
    outer = valid[..., [0, -1]]
    return float(np.median(p[..., [0, -1]][outer] if outer.any() else p[valid]))


def too_narrow(question: str, unit: str) -> Finding:
    """Answers ``question`` by "cannot tell", because the panel has fewer than 8 columns."""
    return Finding(question, CANNOT_TELL, 0.0, 0.0, unit, f"fewer than {FEWEST_COLUMNS} columns")


def same_from_everywhere(question: str) -> Finding:
    """Answers ``question`` by "cannot tell", because the object looks the same from every angle."""
    return Finding(question, CANNOT_TELL, 0.0, 0.0, "", "the object looks too much the same from every angle")
