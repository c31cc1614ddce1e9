"""What a check found: one answer per question, with the number it rests on."""

from dataclasses import asdict, dataclass

OK, SUSPICIOUS, CANNOT_TELL = "ok", "suspicious", "cannot tell"
PIXEL_SIZES = "x_pixel_size and y_pixel_size (--pixel-size-mm of import)"
MIRROR_U, MIRROR_V = "--column-0 (left or right)", "--row-0 (top or bottom)"  # of import
FEWEST_COLUMNS = 8  # four gave false alarms, five did not


@dataclass(frozen=True)
class Finding:
    """The answer to one question: ``ok``, ``suspicious`` or ``cannot tell``. value: what was measured, in ``unit``,
    with its standard deviation ``uncertainty`` where it is an estimate; threshold: from where it is suspicious. text:
    what was found, advice: what to do about it."""

    question: str
    verdict: str
    value: float
    threshold: float
    unit: str
    text: str
    advice: str = ""
    uncertainty: float | None = None

    def facts(self) -> dict[str, object]:
        """The fields as plain values, for JSON."""
        return asdict(self)


def too_narrow(question: str, unit: str) -> Finding:
    """The answer to a question about columns, of a panel that has too few."""
    return Finding(question, CANNOT_TELL, 0.0, 0.0, unit, f"fewer than {FEWEST_COLUMNS} columns")
