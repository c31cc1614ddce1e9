"""The file of a sweep: scans by pattern, settings by product and one by one, seeds, all checked before any run."""

import glob
import hashlib
import itertools
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError, PhyradgsError
from phyradgs_cl.io.hdf5.source import open_hdf5
from phyradgs_cl.io.output import shortened
from phyradgs_cl.io.scan.header import read_header
from phyradgs_cl.io.tables import read_toml, refuse_unknown
from phyradgs_cl.reconstructors import DEFAULT_METHOD, RunPlan, method_name, plan_run
from phyradgs_cl.text import flattened, nested, plain_text
from phyradgs_cl.workflow.files import expecting


@dataclass(frozen=True)
class SweepRun:
    """One reconstruction, as a worker gets it. facts: how its line in the results file begins; ``run`` is its name."""

    scan: Path
    plan: RunPlan
    output: Path
    facts: dict[str, Any]
    checkpoint_every_s: float


def plan_sweep(path: Path, folder: Path, checkpoint_every_s: float = 600.0) -> list[SweepRun]:
    """Returns every run of the file GRID.toml, scan by scan. Volumes go to ``folder``/volumes. Patterns start at the folder
    of ``path``. A name stands for a scan (path, size, time), a setting and a seed. Raises InputError for everything that
    would stop a run: unknown keys, values out of range, patterns that match nothing, files that are no scans."""
    document = read_toml(path, f"GRID {path}")
    refuse_unknown(f"{path}:", document, ("scans", "seeds", "options", "grid", "runs"))
    patterns = _list(document.get("scans"), str, f"{path}: scans", 'a list of files or patterns, as ["scans/*.h5"]')
    seeds = dict.fromkeys(_list(document.get("seeds", [0]), int, f"{path}: seeds", "a list of whole numbers"))
    settings, runs = list(_settings(document, path)), []
    for scan in dict.fromkeys(scan for pattern in patterns for scan in _files(pattern, path)):
        with expecting(scan, "scan"), open_hdf5(scan) as source:
            read_header(source)
        version = [str(scan), scan.stat().st_size, scan.stat().st_mtime_ns]
        for values, seed in itertools.product(settings, seeds):
            plan = _plan(values, seed, str(path))
            label = " ".join([plan.method_name, *(f"{n}={value}" for n, value in values.items() if n != "method")])
            digest = hashlib.sha256(json.dumps([version, values], sort_keys=True, default=str).encode()).hexdigest()[:10]
            name = f"{shortened(plain_text(scan.stem), 80)}_{plan.method_name}_{digest}_s{seed}"
            facts = {"run": name, "scan": str(scan), "method": plan.method_name, "options": values, "label": label}
            facts |= {"seed": seed, "volume": f"volumes/{name}.h5"}
            runs.append(SweepRun(scan, plan, folder.resolve() / str(facts["volume"]), facts, checkpoint_every_s))
    return list({run.facts["run"]: run for run in runs}.values())


def _list(values: Any, kind: type, subject: str, expected: str) -> list[Any]:
    if not (isinstance(values, list) and values and all(type(value) is kind for value in values)):
        raise InputError(subject, checks.short_repr(values), expected)
    return values


def _files(pattern: str, path: Path) -> list[Path]:
    folder = path.resolve().parent
    files = sorted(name for name in glob.glob(str(folder / pattern), recursive=True) if os.path.isfile(name))
    if not files:
        remedy = f"patterns start at the folder of the file, {folder}"
        raise InputError(f"{path}: scans", f"no file for {pattern!r}", "at least one scan file", remedy)
    return [Path(os.path.abspath(name)) for name in files]


def _settings(document: Mapping[str, Any], path: Path) -> Iterator[dict[str, Any]]:
    """Yields the options of every setting by dotted name: combinations of the lists of [[grid]], and [[runs]]."""
    keys = [key for key in ("grid", "runs") if key in document]
    if not keys:
        remedy = "write for example [[grid]] with method = ['fdk', 'sirt']"
        raise InputError(str(path), "neither [[grid]] nor [[runs]]", "at least one of them", remedy)
    (shared,) = _list([document.get("options", {})], dict, f"{path}: options", "a table")
    for key in keys:
        for table in _list(document[key], dict, f"{path}: {key}", f"tables that begin with [[{key}]]"):
            stated = dict(flattened(table))
            lists = [value if isinstance(value, list) and key == "grid" else [value] for value in stated.values()]
            if [] in lists:
                raise InputError(f"{path}: [[grid]]", "an empty list", "the values to try")
            for values in itertools.product(*lists):
                yield {**dict(flattened(shared)), **dict(zip(stated, values, strict=True))}


def _plan(values: Mapping[str, Any], seed: int, where: str) -> RunPlan:
    """Returns the plan of a run; its errors state the values."""
    options = nested(values)
    method, preset = options.pop("method", DEFAULT_METHOD), options.pop("preset", None)
    try:
        return plan_run(method_name(method), options, preset=preset, seed=seed)
    except PhyradgsError as error:
        stated = ", ".join(f"{name}={checks.short_repr(value)}" for name, value in values.items())
        raise type(error)(f"{where} ({stated}): {error.subject}", error.found, error.expected, error.remedy) from error
