"""Provenance as JSON. Users edit such files: a field of a wrong type is left out with a warning, the others are kept."""

import json
import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError

_LARGEST = 1e300
_log = logging.getLogger(__name__)
Facts = dict[str, object]


@dataclass(frozen=True)
class Kind:
    """A type of value: its name in messages, and the test of a value. None (not known) passes everywhere."""

    name: str
    fits: Callable[[object], bool]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


TEXT = Kind("a text", lambda value: isinstance(value, str))
WHOLE = Kind("a whole number", lambda value: type(value) is int and abs(value) < 2**63)
NUMBER = Kind("a finite number", lambda value: _is_number(value) and abs(value) < _LARGEST)  # type: ignore[arg-type]
SECONDS = Kind("a time of at least 0 s", lambda value: NUMBER.fits(value) and value >= 0)  # type: ignore[operator]
TABLE = Kind("a table", lambda value: isinstance(value, dict))
TABLES = Kind("a list of tables", lambda value: isinstance(value, list) and all(map(TABLE.fits, value)))
FINITE = Kind(
    "a table of finite numbers",
    lambda value: isinstance(value, dict) and all(v is None or NUMBER.fits(v) for v in value.values()),
)

Schema = Mapping[str, Kind]
PROVENANCE: Schema = {
    **dict.fromkeys(("method", "program", "scan", "scan_sha256", "device"), TEXT),
    **dict.fromkeys(("seed", "gaussians", "interrupted_at"), WHOLE),
    **dict.fromkeys(("options", "input"), TABLE),
    "seconds": SECONDS,
    "record": TABLES,
}


def damage(facts: Mapping[str, object], schema: Schema, required: Collection[str] = ()) -> dict[str, str]:
    """Returns the fields of ``facts`` that are missing or of a wrong type, with the name of the right type."""
    wrong = {name: schema[name].name for name in required if facts.get(name) is None}
    for name, value in facts.items():
        kind = schema.get(name)
        if kind is not None and value is not None and not kind.fits(value):
            wrong[name] = kind.name
    return wrong


def read_facts(subject: str, text: str, schema: Schema) -> Facts:
    """Parses a JSON object without its damaged fields, which are logged. InputError for other text."""
    try:
        facts = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(subject, f"text that is not JSON ({error})", "a JSON object") from error
    if not isinstance(facts, dict):
        raise InputError(subject, f"JSON {type(facts).__name__}", "a JSON object")
    for name, expected in damage(facts, schema).items():
        _log.warning("%s: %s is left out: expected %s", subject, checks.shown(name), expected)
        del facts[name]
    return facts
