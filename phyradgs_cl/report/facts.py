"""Facts as words and numbers for people: labels with units, a few digits, nested tables flattened."""

import math
from collections.abc import Iterator, Mapping

UNITS = {"_per_mm": "1/mm", "_mm": "mm", "_deg": "°", "_db": "dB", "_s": "s"}
_RESOLUTION = {"mm": 1e-4, "°": 1e-4, "s": 1e-6}  # finer than anything a scanner knows
_WORDS = {"psnr": "PSNR", "rms": "RMS", "ssim": "SSIM", "sha256": "SHA-256", "tv": "TV", "l1": "L1", "fdk": "FDK"}
_LONGEST = 400
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def flattened(facts: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    """(key, value) of all facts, those of nested tables with a dotted key."""
    for key, value in facts.items():
        if isinstance(value, Mapping):
            yield from flattened(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def label(key: str) -> str:
    """``source_to_axis_mm`` as "source to axis"."""
    for ending in UNITS:
        if key.endswith(ending) and key != ending:
            key = key[: -len(ending)]
            break
    return " ".join(_WORDS.get(word, word) for word in key.replace("_", " ").split())


def unit(key: str) -> str:
    """The unit in which a fact of this name is given; empty where there is none."""
    return next((u for ending, u in UNITS.items() if key.endswith(ending)), "")


def shown(value: object, unit_name: str = "") -> str:
    """A value with its unit, short enough to be read."""
    text = _text(value, _RESOLUTION.get(unit_name, 0.0))
    if len(text) > _LONGEST:
        text = text[:_LONGEST] + "…"
    space = "" if unit_name in ("", "°") else "\N{NARROW NO-BREAK SPACE}"
    return f"{text}{space}{unit_name}"


def number(value: float, resolution: float = 0.0) -> str:
    """Four digits at most, powers of ten only where they save zeros; a millionth of ``resolution`` or less is 0, rounded."""
    if abs(value) <= 1e-6 * resolution:
        value = 0.0
    if not math.isfinite(value):
        return "∞" if value > 0 else "−∞" if value < 0 else "not a number"
    text = f"{value:.4g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}·10{str(int(exponent)).translate(_RAISED)}"
    return text.replace("-", "−")


def _text(value: object, resolution: float) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value}" if abs(value) < 100_000 else f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    if isinstance(value, float):
        return number(value, resolution)
    if isinstance(value, list | tuple):
        return ", ".join(_text(part, resolution) for part in value) if len(value) <= 12 else f"{len(value)} values"
    return str(value)
