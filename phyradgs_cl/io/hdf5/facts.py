"""What a file says of how it was made: JSON that anybody may have edited, in which damage to one field costs that one."""

import json
import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError

MOST_BYTES = 64 << 20
_LONGEST_TEXT, _DEEPEST, _LARGEST_WHOLE, _LARGEST = 10_000, 16, 2**63, 1e300
_log = logging.getLogger(__name__)
Facts = dict[str, object]


@dataclass(frozen=True)
class Kind:
    """A kind of value: how messages call it, and whether a value is of it. None, for not known, is of every kind."""

    name: str
    fits: Callable[[object], bool]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


TEXT = Kind("a text", lambda value: isinstance(value, str))
WHOLE = Kind("a whole number", lambda value: type(value) is int)
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
    """The fields of ``facts`` that are missing or not of their kind, each with the kind that it should be of."""
    wrong = {name: schema[name].name for name in required if facts.get(name) is None}
    for name, value in facts.items():
        kind = schema.get(name)
        if kind is not None and value is not None and not kind.fits(value):
            wrong[name] = kind.name
        elif not _can_be_shown([name, value]):
            wrong[name] = f"at most {_LONGEST_TEXT} characters, {_DEEPEST} tables in each other, numbers of 64 bits"
    return wrong


def read_facts(subject: str, text: str, schema: Schema) -> Facts:
    """The JSON object in ``text`` (else InputError) without its damaged fields, of which the log has a word."""
    try:
        if len(text) > MOST_BYTES:
            raise ValueError(f"{len(text)} characters")
        facts = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(subject, f"text that is not JSON ({error})", "a JSON object") from error
    if not isinstance(facts, dict):
        raise InputError(subject, f"JSON {type(facts).__name__}", "a JSON object")
    for name, expected in damage(facts, schema).items():
        _log.warning("%s: %s is left out: expected %s", subject, checks.shown(name), expected)
        del facts[name]
    return facts


def _can_be_shown(value: object, depth: int = 0) -> bool:
    if isinstance(value, str):
        return len(value) <= _LONGEST_TEXT
    if isinstance(value, dict):
        value = [*value, *value.values()]
    if isinstance(value, list):
        return depth <= _DEEPEST and all(_can_be_shown(part, depth + 1) for part in value)
    return not isinstance(value, int) or abs(value) <= _LARGEST_WHOLE
