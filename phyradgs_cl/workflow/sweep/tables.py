"""A sweep's results as tables: one line per setting in Markdown, one line per run in CSV."""

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl.io import written_beside
from phyradgs_cl.io.json_lines import Line
from phyradgs_cl.text import plain_text
from phyradgs_cl.workflow.sweep.grid import flat
from phyradgs_cl.workflow.sweep.plan import SweepRun, same_run

_METRICS = {"psnr_db": ("PSNR (dB)", ".2f"), "ssim": ("SSIM", ".4f")}
_HELD_OUT = {"holdout_rms": ("held-out RMS", ".4g"), "holdout_noise_rms": ("of noise", ".4g")}  # where it was asked for
_FACTS = ("run", "scan", "method", "preset", "seed")
_RESULTS = ("psnr_db", "ssim", *_HELD_OUT, "seconds", "gaussians", "device", "host", "version", "volume", "error")


def write_tables(folder: Path, lines: Sequence[Line], plan: Sequence[SweepRun]) -> list[Path]:
    """Writes results.md and results.csv about the planned runs, by their newest lines; the two paths."""
    newest = {line["run"]: line for line in lines}
    found = [(newest[run.name], run.facts) for run in plan if run.name in newest]
    chosen = [line for line, facts in found if same_run(line, facts)]
    tables = {"results.md": markdown(chosen, len(plan)), "results.csv": comma_separated(chosen)}
    written = {folder / name: text for name, text in tables.items()}
    for path, text in written.items():
        with written_beside(path) as temporary:
            temporary.write_text(plain_text(text), encoding="utf-8", newline="")
    return list(written)


def markdown(lines: Sequence[Line], planned: int) -> str:
    """Means and standard deviations over the scans and seeds of every setting, the failed runs below."""
    done = [line for line in lines if "error" not in line]
    asked = {name for line in done for name in line["metrics"]}
    metrics = {**_METRICS, **{name: column for name, column in _HELD_OUT.items() if name in asked}}
    rows = [
        f"{len(done)} of {planned} runs, {len(lines) - len(done)} failed; mean ± standard deviation over scans and seeds.",
        "",
        "| setting | runs | " + " | ".join(title for title, _ in metrics.values()) + " | seconds |",
        "| --- | ---: |" + " ---: |" * (len(metrics) + 1),
    ]
    for label in dict.fromkeys(line["label"] for line in done):
        same = [line for line in done if line["label"] == label]
        found = {name: [line["metrics"].get(name) for line in same] for name in metrics}
        numbers = [_spread(found[name], form) for name, (_, form) in metrics.items()]
        seconds = _spread([line["seconds"] for line in same], ".1f")
        rows.append("| " + " | ".join([_cell(label), str(len(same)), *numbers, seconds]) + " |")
    rows += _failures([line for line in lines if "error" in line])
    return "\n".join([*rows, ""])


def _failures(failed: Sequence[Line]) -> Iterator[str]:
    if failed:
        yield from ("", "| failed run | setting | error |", "| --- | --- | --- |")
    for line in failed:
        yield f"| {_cell(line['run'])} | {_cell(line['label'])} | {_cell(line['error'])} |"


def comma_separated(lines: Sequence[Line]) -> str:
    """A record per run; a column for every option that any run states."""
    stated = [dict(flat({**line["input"], **line["changes"]})) for line in lines]
    names = list(dict.fromkeys(name for options in stated for name in options))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*_FACTS, *names, *_RESULTS])
    for line, options in zip(lines, stated, strict=True):
        found = {**line, **line.get("metrics", {})}
        values = [found.get(name) for name in _FACTS] + [options.get(name) for name in names]
        writer.writerow([*values, *(found.get(name) for name in _RESULTS)])
    return stream.getvalue()


def _spread(values: Sequence[Any], form: str) -> str:
    known = [float(value) for value in values if value is not None]
    if not known:
        return "–"
    mean = format(np.mean(known), form)
    return f"{mean} ± {np.std(known, ddof=1):{form}}" if len(known) > 1 else mean


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
