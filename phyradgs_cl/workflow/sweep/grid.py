"""The file of a sweep: scans by pattern, settings by product and one by one, seeds, all checked before any run. Also a first
comparison of methods, over fly-scans of two built-in phantoms, in a minute or two."""

import itertools
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phyradgs_cl import checks
from phyradgs_cl import reconstructors as methods
from phyradgs_cl.errors import InputError, PhyradgsError
from phyradgs_cl.io.hdf5.source import open_hdf5
from phyradgs_cl.io.output import make_folder
from phyradgs_cl.io.scan.header import read_header
from phyradgs_cl.io.tables import refuse_unknown
from phyradgs_cl.runtime import MEMORY_VARIABLE, Runtime
from phyradgs_cl.simulation import scanner_for, scanner_options
from phyradgs_cl.text import flattened, plain_text
from phyradgs_cl.workflow.files import expecting
from phyradgs_cl.workflow.scans import SimulationJob, run_simulation

MOST_RUNS = 100_000
_LARGEST_SEED = 2**63
_KEYS = ("scans", "seeds", "options", "grid", "runs")
_ELSEWHERE = {
    "seed": "write seeds = [0, 1] at the top",
    "device": "say it as --device, or in the environment of the workers",
    "memory": f"say it as {MEMORY_VARIABLE} in the environment of the workers",
}
Table = Mapping[str, Any]
PHANTOMS, VOXELS, PIXELS, ITERATIONS = ("foot", "jaw"), 32, 64, 600
_ROWS: tuple[tuple[str, Table], ...] = (
    ("fdk", {"motion": "static"}),
    ("fista-tv", {"motion": "per-row"}),
    ("fista", {"motion": "static"}),
    ("fista", {"motion": "per-row"}),
    ("r2", {"motion": "static"}),
    ("phyradgs", {"motion": "static"}),
    ("phyradgs", {"motion": "micro-views", "strips": 8, "sub_intervals": 5}),
    ("phyradgs", {"motion": "exact"}),
)


@dataclass(frozen=True)
class Setting:
    """A method, its preset, the options that differ from the preset, and the preprocessing of the frames."""

    method: str
    preset: str
    changes: Table
    before: Table

    def plan(self, seed: int = 0) -> methods.RunPlan:
        return methods.plan_run(self.method, {**self.changes, **self.before}, preset=self.preset, seed=seed)

    @property
    def label(self) -> str:
        """A short text: the method, the preset where it is not the usual one, options by dotted name."""
        words = [self.method]
        if self.preset != methods.usual_preset(self.method):
            words.append(f"preset={self.preset}")
        for name, value in flattened({**self.before, **self.changes}):
            words.append(f"{name}={','.join(map(str, value)) if isinstance(value, list) else value}")
        return " ".join(words)


@dataclass(frozen=True)
class SweepGrid:
    """Every scan is reconstructed with every setting and every seed."""

    scans: tuple[Path, ...]
    settings: tuple[Setting, ...]
    seeds: tuple[int, ...]


def read_grid(document: Table, path: Path) -> SweepGrid:
    """Returns the scans, settings and seeds of GRID.toml; its patterns start at the folder of ``path``. Raises InputError
    for everything that would stop a run: unknown keys, values out of range, patterns that match nothing, files that are no
    scans."""
    refuse_unknown(f"{path}:", document, _KEYS)
    settings = _settings(document, path)
    seeds = _seeds(document.get("seeds", [0]), path)
    scans = _scans(document.get("scans"), path)
    _limit_runs(str(path), len(scans) * len(settings) * len(seeds))
    for scan in scans:
        with expecting(scan, "scan"), open_hdf5(scan) as source:
            read_header(source)
    return SweepGrid(scans, settings, seeds)


def _nested(values: Table) -> dict[str, Any]:
    """Returns nested tables from dotted names."""
    tables: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        table = tables
        for group in groups:
            table = table.setdefault(group, {})
            if not isinstance(table, dict):
                raise InputError(name, f"{group}={checks.short_repr(table)} too", f"a value or a table {group}")
        table[last] = value
    return tables


def _scans(patterns: Any, path: Path) -> tuple[Path, ...]:
    subject = f"{path}: scans"
    if not _is_list_of(str, patterns):
        expected = 'a list of file names or patterns, as scans = ["scans/*.h5"]'
        raise InputError(subject, checks.short_repr(patterns), expected)
    folder = path.resolve().parent
    scans: dict[Path, None] = {}
    for pattern in patterns:
        files = _files(plain_text(pattern), folder, subject)
        if not files:
            remedy = f"patterns start at the folder of the file, {folder}"
            raise InputError(subject, f"no file for {pattern!r}", "at least one scan file", remedy)
        scans.update((Path(os.path.abspath(file)), None) for file in files)
    return tuple(scans)


def _files(pattern: str, folder: Path, subject: str) -> list[Path]:
    """Returns the regular files that match, sorted; a name without wildcards stands for itself, whatever it is."""
    parts = (folder / pattern).parts
    wild = next((k for k, part in enumerate(parts) if set(part) & set("*?[")), None)
    if wild is None:
        return [folder / pattern] if os.path.lexists(folder / pattern) else []
    matches = Path(*parts[:wild]).glob(str(Path(*parts[wild:])))
    files = (match for match in matches if match.is_file() and not match.name.startswith("."))
    limited = list(itertools.islice(files, MOST_RUNS + 1))
    _limit_runs(subject, len(limited))
    return sorted(set(limited))


def _seeds(seeds: Any, path: Path) -> tuple[int, ...]:
    if not (_is_list_of(int, seeds) and all(type(s) is int and 0 <= s <= _LARGEST_SEED for s in seeds)):
        expected = f"a list of whole numbers from 0 to {_LARGEST_SEED}"
        raise InputError(f"{path}: seeds", checks.short_repr(seeds), expected)
    return tuple(dict.fromkeys(seeds))


def _is_list_of(kind: type, values: Any) -> bool:
    return isinstance(values, list) and bool(values) and all(isinstance(value, kind) for value in values)


def _limit_runs(subject: str, count: int) -> None:
    if count > MOST_RUNS:
        raise InputError(subject, f"{count} runs", f"at most {MOST_RUNS}", "split the file into several")


def _settings(document: Table, path: Path) -> tuple[Setting, ...]:
    """Returns the settings of [[grid]] and [[runs]] without repetitions."""
    shared = dict(flattened(_table(document.get("options", {}), f"{path}: [options]")))
    settings: dict[str, Setting] = {}
    for key in ("grid", "runs"):
        for where, table in _tables(document, key, path):
            for values in _product(table, where) if key == "grid" else [dict(flattened(table))]:
                setting = _setting({**shared, **values}, where)
                settings.setdefault(repr(setting), setting)
    if not settings:
        remedy = "write for example [[grid]] with method = ['fdk', 'sirt']"
        raise InputError(str(path), "neither [[grid]] nor [[runs]]", "at least one of them", remedy)
    return tuple(settings.values())


def _tables(document: Table, key: str, path: Path) -> Iterator[tuple[str, Table]]:
    tables = document.get(key, [])
    if not isinstance(tables, list):
        raise InputError(f"{path}: {key}", checks.short_repr(tables), f"tables that begin with [[{key}]]")
    for number, table in enumerate(tables, 1):
        where = f"{path}: [[{key}]] {number}"
        yield where, _table(table, where)


def _table(table: Any, where: str) -> Table:
    if not isinstance(table, Mapping):
        raise InputError(where, checks.short_repr(table), "a table")
    return table


def _product(table: Table, where: str) -> Iterator[dict[str, Any]]:
    """Yields every combination of the lists; a value that is no list is a list of one."""
    axes = {name: values if isinstance(values, list) else [values] for name, values in flattened(table)}
    for name, values in axes.items():
        if not values:
            raise InputError(f"{where}: {name}", "an empty list", "the values to try")
    _limit_runs(where, math.prod(map(len, axes.values())))
    for combination in itertools.product(*axes.values()):
        yield dict(zip(axes, combination, strict=True))


def _setting(values: dict[str, Any], where: str) -> Setting:
    """Returns a checked setting; its errors name the table and the values."""
    try:
        return _checked(values)
    except PhyradgsError as error:
        words = ", ".join(f"{name}={checks.short_repr(value)}" for name, value in values.items())
        subject = f"{where} ({words}): {error.subject}"
        raise type(error)(subject, error.found, error.expected, error.remedy) from error


def _checked(values: dict[str, Any]) -> Setting:
    changes = dict(values)
    method = methods.method_name(changes.pop("method", methods.DEFAULT_METHOD))
    preset = changes.pop("preset", None)
    for name, remedy in _ELSEWHERE.items():
        if name in changes:
            raise InputError(name, checks.short_repr(changes[name]), "no option of a run", remedy)
    names = methods.preprocessing_names(method, preset)
    before = {name: changes.pop(name) for name in names if name in changes}
    nested = _nested(changes)
    methods.plan_run(method, {**nested, **before}, preset=preset)
    return Setting(method, methods.usual_preset(method) if preset is None else preset, nested, before)


def quick_grid(
    folder: Path, make_runtime: Callable[[], Runtime], *, seed: int = 0, iterations: int = ITERATIONS
) -> SweepGrid:
    """Simulates the missing scans in ``folder``/scans; returns a sweep of every method, with and without motion, over them.
    seed: of noise, cloud and frame order. iterations: of splats. Raises OutputError for a folder that cannot be made."""
    checks.within("--iterations", iterations, 0, 10_000_000)
    settings = []
    for method, motion in _ROWS:
        splats = {"iterations": iterations} if method in ("r2", "phyradgs") else {}
        settings.append(Setting(method, methods.usual_preset(method), {**motion, **splats}, {}))
    scans = {name: folder / "scans" / f"{name}_seed{seed}.h5" for name in PHANTOMS}
    missing = [name for name, path in scans.items() if not path.exists()]
    if missing:
        make_folder(folder / "scans", folder)
        rt = make_runtime()
        for name in missing:
            scanner = scanner_for("r2", PIXELS)
            options = scanner_options(scanner, "rapid", noise="tigre", seed=seed)
            job = SimulationJob(scans[name], phantom=name, size=VOXELS)
            run_simulation(job, scanner, options, rt, lambda done, total: None)
    return SweepGrid(tuple(scans.values()), tuple(settings), (seed,))
