"""Builds HTML in such a way that text from files is always escaped, and formats facts as text."""

import html
import json
import math
from collections.abc import Iterable

from phyradgs_cl.text import plain_text

UNITS = {"_per_mm": "1/mm", "_mm": "mm", "_deg": "°", "_db": "dB", "_s": "s"}
_RESOLUTION = {"mm": 1e-4, "°": 1e-4, "s": 1e-6}  # for each unit: numbers up to a millionth of this are shown as 0
_WORDS = {"psnr": "PSNR", "rms": "RMS", "ssim": "SSIM", "sha256": "SHA-256", "tv": "TV", "l1": "L1", "fdk": "FDK"}
_LONGEST = 400  # longer values are cut after this many characters
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class Markup(str):
    """Text that is HTML already. All other text is escaped when it becomes part of an element."""


VOID = frozenset({"br", "img", "input", "link", "meta"})


def element(name: str, /, *children: object, **attributes: object) -> Markup:
    """Returns ``<name attributes>children</name>``. Children that are not Markup are escaped.

    Attributes that are None or False are left out; True writes the name alone. Underscores in attributes' names become
    dashes; one at the end is removed (``class_``)."""
    opening = f"<{name}{''.join(_attribute(key, value) for key, value in attributes.items())}>"
    return Markup(opening) if name in VOID else Markup(f"{opening}{joined(*children)}</{name}>")


def joined(*children: object) -> Markup:
    """Joins the children to one text. Those that are not Markup are escaped; None adds nothing."""
    shown = (c if isinstance(c, Markup) else html.escape(_plain(c)) for c in children if c is not None)
    return Markup("".join(shown))


def raw_text(name: str, content: str, /, **attributes: object) -> Markup:
    """Returns a ``style`` or ``script`` element of trusted text, unescaped. Raises ValueError for text that would end it."""
    if "</" + name in content.lower():
        raise ValueError(f"{name}: the content would end its element")
    return element(name, Markup(content), **attributes)


def json_block(identifier: str, value: object) -> Markup:
    """Returns an element with data for the page's script, as JSON that cannot begin or end an HTML element."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    safe = text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return element("script", Markup(safe), id=identifier, type="application/json")


def _attribute(key: str, value: object) -> str:
    if value is None or value is False:
        return ""
    name = key.rstrip("_").replace("_", "-")
    return f" {name}" if value is True else f' {name}="{html.escape(_plain(value))}"'


def _plain(value: object) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else plain_text(str(value))


def label(key: str) -> str:
    """Returns a key as words without its unit: "source to axis" for ``source_to_axis_mm``."""
    ending = next((ending for ending in UNITS if key.endswith(ending) and key != ending), "")
    return " ".join(_WORDS.get(word, word) for word in key.removesuffix(ending).replace("_", " ").split())


def unit(key: str) -> str:
    """Returns the unit at the end of a key: "mm" for ``source_to_axis_mm``; "" without one."""
    return next((u for ending, u in UNITS.items() if key.endswith(ending)), "")


def shown(value: object, unit_name: str = "") -> str:
    """Returns a value with its unit as text, cut after ``_LONGEST`` characters."""
    text = _text(value, _RESOLUTION.get(unit_name, 0.0))
    if len(text) > _LONGEST:
        text = text[:_LONGEST] + "…"
    space = "" if unit_name in ("", "°") else "\N{NARROW NO-BREAK SPACE}"
    return f"{text}{space}{unit_name}"


def number(value: float, resolution: float = 0.0) -> str:
    """Returns a number as text with at most four significant digits; 0 for sizes up to a millionth of ``resolution``."""
    if abs(value) <= 1e-6 * resolution:
        value = 0.0
    if not math.isfinite(value):
        return "∞" if value > 0 else "−∞" if value < 0 else "not a number"
    text = f"{value:.4g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}·10{str(int(exponent)).translate(_RAISED)}"
    return text.replace("-", "−")


def grouped(value: int) -> str:
    """Returns a whole number with spaces between groups of three digits."""
    return f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def tiles(facts: Iterable[tuple[str, str]]) -> Markup:
    """Returns an HTML list of ``facts`` (name, value), each value in large letters above its name."""
    return element("ul", *(element("li", element("b", v), element("span", name)) for name, v in facts), class_="tiles")


def _text(value: object, resolution: float) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value}" if abs(value) < 100_000 else grouped(value)
    if isinstance(value, float):
        return number(value, resolution)
    if isinstance(value, list | tuple):
        return ", ".join(_text(part, resolution) for part in value) if len(value) <= 12 else f"{len(value)} values"
    return str(value)
