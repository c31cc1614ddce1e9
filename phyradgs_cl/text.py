"""Helpers for text: makes it printable, suggests known names, formats numbers and times, drops repeated warnings."""

import difflib
import logging
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import fields
from functools import partial
from typing import Any

# Control characters may move a terminal's cursor. Lone surrogates, which stand for bytes not in UTF-8, cannot be written.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
_UNIT = re.compile("(.+?)_(per_mm|mm|s|ms|rad|deg|px|db)")  # matches a name that ends in a unit, as ``rim_mm``
_MANY = 8  # of a list with more values, ``value_text`` shows only their number, the first and the last


def plain_text(text: str) -> str:
    """Replaces each character that a terminal, a web page or a file may refuse by U+FFFD, the replacement character."""
    return _UNPRINTABLE.sub("\ufffd", text)


def flag_of(name: str) -> str:
    """Returns the command-line option of a field or an argument: ``--start-deg`` for ``start_deg``."""
    return "--" + name.replace("_", "-")


def suggest_name(name: object, known_names: Iterable[str], otherwise: str) -> str:
    """Returns "did you mean …?" with the most similar known name, or ``otherwise`` if none is similar."""
    close = difflib.get_close_matches(str(name)[:200], list(known_names), n=1)
    return f"did you mean {close[0]!r}?" if close else otherwise


def flattened(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields (name, value) of every value in nested tables. A name includes its tables' names, as in ``rates.position``."""
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from flattened(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Inverts ``flattened``: returns nested tables from dotted names. Of a value and a table of one name, the later wins."""
    tables: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        table = tables
        for group in groups:
            if not isinstance(table.get(group), dict):
                table[group] = {}
            table = table[group]
        table[last] = value
    return tables


def repr_of_changes(thing: Any) -> str:
    """Returns the repr of a dataclass with only the fields that differ from their defaults. Arrays appear as their shape."""
    texts = []
    for field in fields(thing):
        value = getattr(thing, field.name)
        if not field.repr:
            continue
        if hasattr(value, "shape"):
            texts.append(f"{field.name}=array{tuple(value.shape)}")
        elif value != field.default:
            texts.append(f"{field.name}={value!r}")
    return f"{type(thing).__name__}({', '.join(texts)})"


def value_text(value: Any, digits: int = 6) -> str:
    """Returns a value as text: numbers with ``digits`` significant digits, tables as "name value, name value". Entries
    of a table that are None are left out, and tables in it get parentheses. Of a list with more than 8 values, the text has
    their number, the first and the last."""
    match value:
        case float():
            return f"{value:.{digits}g}"
        case Mapping():
            told = {str(name): own for name, own in value.items() if own is not None}
            return ", ".join(_fact_text(name, own, digits) for name, own in told.items())
        case [Mapping(), *_]:
            return "; ".join(value_text(one, digits) for one in value)
        case list() | tuple():
            texts = [value_text(one, digits) for one in value]
            return f"({', '.join(texts)})" if len(texts) <= _MANY else f"{len(texts)} values from {texts[0]} to {texts[-1]}"
    return str(value)


def _fact_text(name: str, value: Any, digits: int) -> str:
    """Returns a name and its value. A unit that ends the name follows the value: ``rim_mm`` of 2 is "rim 2 mm"."""
    of_unit = None if isinstance(value, Mapping | str | bool) else _UNIT.fullmatch(name)
    words, unit = of_unit.groups() if of_unit else (name, "")
    text = f"({value_text(value, digits)})" if isinstance(value, Mapping) else value_text(value, digits)
    return f"{words.replace('_', ' ')} {text} {unit.replace('per_', '1/').replace('db', 'dB')}".rstrip()


def to_digits_of(value: float, deviation: float) -> str:
    """Returns a value as text, with as many decimals as two significant digits of its standard deviation have."""
    return f"{value:.{max(0, 1 - math.floor(math.log10(max(deviation, 1e-12))))}f}"


def clock(seconds: float) -> str:
    """Returns a time in s as minutes:seconds, or hours:minutes:seconds from an hour on."""
    minutes, rest = divmod(int(seconds + 0.5), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}" if minutes >= 60 else f"{minutes}:{rest:02d}"


def _is_warning(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.WARNING and record.name.startswith(f"{__package__}.")


def _is_new(said: set[str], record: logging.LogRecord) -> bool:
    """Returns False for a warning of this package whose message is in ``said``; otherwise adds its message to ``said``."""
    if not _is_warning(record):
        return True
    is_new = record.getMessage() not in said
    said.add(record.getMessage())
    return is_new


def each_warning_once() -> Any:
    """Returns a context manager or decorator that drops this package's warnings that are repeated word for word in it."""
    return _filtered(lambda: partial(_is_new, set()))


def without_warnings() -> AbstractContextManager[None]:
    """Returns a context that drops this package's warnings. An outer ``each_warning_once`` does not count them as given."""
    return _filtered(lambda: lambda record: not _is_warning(record))


@contextmanager
def _filtered(make_filter: Callable[[], Callable[[logging.LogRecord], bool]]) -> Iterator[None]:
    """Puts a filter from ``make_filter`` before the other filters of every log handler while the body runs. A record for
    which the filter returns False is dropped, and an outer ``each_warning_once`` does not see it."""
    handlers = [*logging.getLogger(__package__).handlers, *logging.getLogger().handlers, logging.lastResort]
    filters = [(handler, make_filter()) for handler in handlers if handler is not None]
    for handler, one in filters:
        handler.filters.insert(0, one)
    try:
        yield
    finally:
        for handler, one in filters:
            handler.removeFilter(one)
