"""The command prepare: corrects the effects of panel and beam in a scan."""

import json
from pathlib import Path
from typing import Annotated, Any

from phyradgs_cl.commands.console import AsJson, file_option, option, say
from phyradgs_cl.commands.options import STEPS_OF_PREPARE, Device, IgnoreLag, Memory, Output, Scan
from phyradgs_cl.prepare import DEFAULT_STEPS
from phyradgs_cl.progress import Ticker
from phyradgs_cl.settings import read_settings
from phyradgs_cl.workflow import run_preparation

EXAMPLES = {"prepare": "Example: phyradgs prepare scan.h5 -o clean.h5 --steps sparks,dead,rings --set rings.window=11"}
GROUPS = {
    "prepare": {
        "Basics": ("output", "steps", "assignments", "as_json"),
        "Run": ("config", "ignore_lag", "device", "memory"),
    }
}
_CONFIG = "TOML file of steps and their tables; the command line wins."
_SET = "An option of a step, as --set rings.window=11 (docs: prepare.md)."


def prepare_command(
    scan: Scan, output: Output, steps: Annotated[str | None, STEPS_OF_PREPARE] = None,
    config: Annotated[Path | None, file_option(_CONFIG, "--config")] = None,
    assignments: Annotated[list[str] | None, option(_SET, True, "--set", metavar="NAME=VALUE")] = None,
    ignore_lag: IgnoreLag = False, as_json: AsJson = False, device: Device = None, memory: Memory = None,
) -> None:
    """Correct the effects of panel and beam in a scan: write line integrals and a mask, and print each step's numbers.

    The same steps are options of reconstruct; this command keeps the corrected scan. The default steps find out by
    themselves whether there is something to correct."""
    given = {"steps": steps, "ignore_lag": ignore_lag or None, "device": device, "memory": memory}
    settings = read_settings(config, given, assignments or [])
    preprocessing = settings.preprocessing({"steps": DEFAULT_STEPS})
    with Ticker("step") as ticker, settings.naming_origins():
        ticker.stage(f"preparing {scan.name}")
        done, before = run_preparation(scan, output, preprocessing, settings.runtime, config)
    if as_json:
        say(json.dumps({"scan": str(scan), "output": str(output), "steps": done, "steps_before": before}))
    else:
        earlier = [f"done before  {', '.join(before)}"] if before else []
        say("\n".join([*earlier, *map(_line, done), str(output)]))


def _line(step: dict[str, Any]) -> str:
    numbers = {key: value for key, value in step.items() if key not in ("step", "options")}
    return f"{step['step']:12s} " + ", ".join(f"{key.replace('_', ' ')} {_short(value)}" for key, value in numbers.items())


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{_short(own)} {key.replace('_', ' ')}" for key, own in value.items())
    return (", ".join(map(_short, value)) or "none") if isinstance(value, list) else str(value)
