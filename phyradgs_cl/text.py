"""Text from strangers: made fit for terminals, pages and files, and compared with what is known. Numbers as text."""

import difflib
import math
import re
from collections.abc import Iterable
from dataclasses import fields
from typing import Any

# Controls but tab and line feed, which would move a terminal's cursor or end a string; half a surrogate pair, by which
# Python stands for a byte of a name that is not UTF-8, and which nothing encodes.
_UNFIT = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")


def plain_text(text: str) -> str:
    """``text`` with a replacement character for everything that not every terminal, page or file takes."""
    return _UNFIT.sub("\ufffd", text)


def near_miss(name: object, known: Iterable[str], otherwise: str) -> str:
    """What to do about a name that is not known: take the one that it nearly is, or ``otherwise``."""
    close = difflib.get_close_matches(str(name)[:200], list(known), n=1)
    return f"did you mean {close[0]!r}?" if close else otherwise


def short_repr(thing: Any) -> str:
    """A dataclass with the fields that are not as they are by themselves; of arrays the shape."""
    shown = []
    for field in fields(thing):
        value = getattr(thing, field.name)
        if not field.repr:
            continue
        if hasattr(value, "shape"):
            shown.append(f"{field.name}=array{tuple(value.shape)}")
        elif value != field.default:
            shown.append(f"{field.name}={value!r}")
    return f"{type(thing).__name__}({', '.join(shown)})"


def to_digits_of(value: float, deviation: float) -> str:
    """A value with the decimals that two digits of its deviation have."""
    return f"{value:.{max(0, 1 - math.floor(math.log10(max(deviation, 1e-12))))}f}"
