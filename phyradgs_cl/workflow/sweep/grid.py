"""What a sweep's file asks for: scans by pattern, settings by product and one by one, seeds; checked whole."""

import itertools
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError, PhyradgsError
from phyradgs_cl.io.hdf5.source import open_hdf5
from phyradgs_cl.io.scan.header import read_header
from phyradgs_cl.io.tables import refuse_unknown
from phyradgs_cl.reconstructors import (
    DEFAULT_METHOD,
    input_names,
    input_options,
    method_name,
    method_options,
    usual_preset,
)
from phyradgs_cl.runtime import MEMORY_VARIABLE
from phyradgs_cl.text import plain_text
from phyradgs_cl.workflow.files import expecting
from phyradgs_cl.workflow.sweep.patterns import Search

MOST_RUNS = 100_000
_LARGEST_SEED = 2**63
_DEEPEST = 8  # tables in tables: no option is deeper than two
_KEYS = ("scans", "seeds", "options", "grid", "runs")
_ELSEWHERE = {
    "seed": "write seeds = [0, 1] at the top",
    "device": "say it as --device, or in the environment of the workers",
    "memory": f"say it as {MEMORY_VARIABLE} in the environment of the workers",
}
Table = Mapping[str, Any]


@dataclass(frozen=True)
class Setting:
    """A method with its preset and the options that differ from it; ``before`` is done to the frames first."""

    method: str
    preset: str
    changes: Table
    before: Table

    def options(self) -> Any:
        """The method's options, checked."""
        return method_options(self.method, self.preset, self.changes, str(self.before.get("tune", "")))

    @property
    def label(self) -> str:
        """The setting in a line: the preset where it is not the method's first, options with dotted names."""
        usual = usual_preset(self.method)
        named = [] if self.preset == usual else [f"preset={self.preset}"]
        for name, value in flat({**self.before, **self.changes}):
            named.append(f"{name}={','.join(map(str, value)) if isinstance(value, list) else value}")
        return " ".join([self.method, *named])


@dataclass(frozen=True)
class SweepGrid:
    """Every scan is reconstructed with every setting and every seed."""

    scans: tuple[Path, ...]
    settings: tuple[Setting, ...]
    seeds: tuple[int, ...]


def read_grid(document: Table, path: Path) -> SweepGrid:
    """GRID.toml as scans, settings and seeds; patterns start at the folder of ``path``. InputError for whatever a run would
    stumble over: unknown keys, values out of range, patterns that match nothing, files that are no scans."""
    refuse_unknown(f"{path}:", document, _KEYS)
    settings = _settings(document, path)
    seeds = _seeds(document.get("seeds", [0]), path)
    scans = _scans(document.get("scans"), path)
    if (count := len(scans) * len(settings) * len(seeds)) > MOST_RUNS:
        raise InputError(str(path), f"{count} runs", f"at most {MOST_RUNS}", "make several files of it")
    for scan in scans:
        with expecting(scan, "scan"), open_hdf5(scan) as source:
            read_header(source)
    return SweepGrid(scans, settings, seeds)


def flat(table: Table, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted name, value) of everything in nested tables."""
    if prefix.count(".") > _DEEPEST:
        raise InputError(prefix[:60], "tables in tables in tables", f"at most {_DEEPEST} of them")
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _nested(pairs: Iterator[tuple[str, Any]]) -> dict[str, Any]:
    table: dict[str, Any] = {}
    for name, value in pairs:
        *groups, last = name.split(".")
        inside = table
        for group in groups:
            inside = inside.setdefault(group, {})
            if not isinstance(inside, dict):
                raise InputError(name, f"{group}={checks.shown(inside)} too", f"a value or a table {group}")
        inside[last] = value
    return table
# --- scans and seeds --------------------------------------------------------------------------------------


def _scans(patterns: Any, path: Path) -> tuple[Path, ...]:
    if not _is_list_of(str, patterns):
        expected = 'a list of file names or patterns, as scans = ["scans/*.h5"]'
        raise InputError(f"{path}: scans", checks.shown(patterns), expected)
    found: dict[Path, None] = {}
    search, start = Search(f"{path}: scans"), path.resolve().parent
    for pattern in patterns:
        names = search.files(plain_text(pattern), start)
        if not names:
            remedy = f"patterns start at the folder of the file, {start}"
            raise InputError(f"{path}: scans", f"no file for {pattern!r}", "at least one scan file", remedy)
        found.update((Path(os.path.abspath(name)), None) for name in names)
    return tuple(found)


def _seeds(seeds: Any, path: Path) -> tuple[int, ...]:
    if not (_is_list_of(int, seeds) and all(type(s) is int and 0 <= s <= _LARGEST_SEED for s in seeds)):
        expected = f"a list of whole numbers from 0 to {_LARGEST_SEED}"
        raise InputError(f"{path}: seeds", checks.shown(seeds), expected)
    return tuple(dict.fromkeys(seeds))


def _is_list_of(kind: type, values: Any) -> bool:
    return isinstance(values, list) and bool(values) and all(isinstance(value, kind) for value in values)
# --- settings ---------------------------------------------------------------------------------------------


def _settings(document: Table, path: Path) -> tuple[Setting, ...]:
    shared = dict(flat(_table(document.get("options", {}), f"{path}: [options]")))
    chosen: dict[str, Setting] = {}
    for where, table in _tables(document, "grid", path):
        for combination in _product(table, where):
            setting = _setting({**shared, **combination}, where)
            chosen.setdefault(repr(setting), setting)
    for where, table in _tables(document, "runs", path):
        setting = _setting({**shared, **dict(flat(table))}, where)
        chosen.setdefault(repr(setting), setting)
    if not chosen:
        remedy = "write for example [[grid]] with method = ['fdk', 'sirt']"
        raise InputError(str(path), "neither [[grid]] nor [[runs]]", "at least one of them", remedy)
    return tuple(chosen.values())


def _tables(document: Table, key: str, path: Path) -> Iterator[tuple[str, Table]]:
    tables = document.get(key, [])
    if not isinstance(tables, list):
        raise InputError(f"{path}: {key}", checks.shown(tables), f"tables that begin with [[{key}]]")
    for number, table in enumerate(tables, 1):
        where = f"{path}: [[{key}]] {number}"
        yield where, _table(table, where)


def _table(table: Any, where: str) -> Table:
    if not isinstance(table, Mapping):
        raise InputError(where, checks.shown(table), "a table")
    return table


def _product(table: Table, where: str) -> Iterator[dict[str, Any]]:
    """Every combination of the lists; a value that is no list is a list of one."""
    axes = {name: values if isinstance(values, list) else [values] for name, values in flat(table)}
    for name, values in axes.items():
        if not values:
            raise InputError(f"{where}: {name}", "an empty list", "the values to try")
    if (count := math.prod(map(len, axes.values()))) > MOST_RUNS:
        raise InputError(where, f"{count} combinations", f"at most {MOST_RUNS}")
    for chosen in itertools.product(*axes.values()):
        yield dict(zip(axes, chosen, strict=True))


def _setting(values: dict[str, Any], where: str) -> Setting:
    """A setting whose options exist and are in range; an error says which table, and which values of it."""
    try:
        return _checked(values)
    except PhyradgsError as error:
        told = ", ".join(f"{name}={checks.shown(value)}" for name, value in values.items())
        subject = f"{where} ({told}): {error.subject}"
        raise type(error)(subject, error.found, error.expected, error.remedy) from error


def _checked(values: dict[str, Any]) -> Setting:
    changes = dict(values)
    method, preset = method_name(changes.pop("method", DEFAULT_METHOD)), changes.pop("preset", None)
    for name, remedy in _ELSEWHERE.items():
        if name in changes:
            raise InputError(name, checks.shown(changes[name]), "no option of a run", remedy)
    before = {name: changes.pop(name) for name in input_names(method, preset) if name in changes}
    tune = input_options(before).tune
    nested = _nested(iter(changes.items()))
    method_options(method, preset, nested, tune)
    return Setting(method, usual_preset(method) if preset is None else preset, nested, before)
