"""prepare: what the panel and the beam did to a scan, undone."""

import json
from pathlib import Path
from typing import Annotated, Any

from phyradgs_cl.commands.console import AsJson, say
from phyradgs_cl.commands.files import file_option, option
from phyradgs_cl.commands.options import STEPS_OF_PREPARE, Device, Memory, Output, Scan
from phyradgs_cl.prepare import DEFAULT_STEPS
from phyradgs_cl.progress import Ticker
from phyradgs_cl.settings import read_settings
from phyradgs_cl.workflow import run_preparation

EXAMPLE = "Example: phyradgs prepare scan.h5 -o clean.h5 --steps sparks,dead,rings --set rings.window=11"

_CONFIG = "TOML file of steps and their tables; the command line wins."
_SET = "Any option of a step, as --set rings.window=11. Docs: prepare.md."


def prepare_command(
    scan: Scan,
    output: Output,
    steps: Annotated[str | None, STEPS_OF_PREPARE] = None,
    config: Annotated[Path | None, file_option(_CONFIG, "--config")] = None,
    assignments: Annotated[list[str] | None, option(_SET, True, "--set", metavar="NAME=VALUE")] = None,
    ignore_lag: Annotated[bool, option("Leave the lag that the scan file states.", True, "--ignore-lag")] = False,
    as_json: AsJson = False,
    device: Device = None,
    memory: Memory = None,
) -> None:
    """Undo what the panel and the beam did to a scan: write line integrals and a mask, and say what each step did.

    The same steps are options of reconstruct; this writes them down once, to be looked at. Without --steps: those that find
    for themselves whether there is anything to do.
    """
    given = {"steps": steps, "ignore_lag": ignore_lag or None, "device": device, "memory": memory}
    settings = read_settings(config, given, assignments or [])
    preprocessing = settings.preprocessing({"steps": DEFAULT_STEPS})
    with Ticker("step") as ticker, settings.naming_origins():
        ticker.stage(f"preparing {scan.name}")
        told = run_preparation(scan, output, preprocessing, settings.runtime, config)
    if as_json:
        say(json.dumps({"scan": str(scan), "output": str(output), "steps": told}))
    else:
        say("\n".join([*map(_line, told), str(output)]))


def _line(step: dict[str, Any]) -> str:
    """What a step did, in numbers."""
    numbers = {key: value for key, value in step.items() if key not in ("step", "options")}
    return f"{step['step']:12s} " + ", ".join(f"{key.replace('_', ' ')} {_shown(value)}" for key, value in numbers.items())


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{_shown(own)} {key.replace('_', ' ')}" for key, own in value.items())
    return (", ".join(map(_shown, value)) or "none") if isinstance(value, list) else str(value)
