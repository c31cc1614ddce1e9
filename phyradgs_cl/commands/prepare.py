"""The command prepare: corrects the effects of panel and beam in a scan."""

from pathlib import Path
from typing import Annotated, Any

from phyradgs_cl.commands.console import AsJson, file_option, option, say, say_json
from phyradgs_cl.commands.options import Device, Memory, Output, Scan, settings_of, with_options
from phyradgs_cl.prepare.chain import DEFAULT_STEPS, STEPS_HELP
from phyradgs_cl.progress import Ticker
from phyradgs_cl.settings import Settings
from phyradgs_cl.text import value_text
from phyradgs_cl.workflow import run_preparation

EXAMPLES = {"prepare": "Example: phyradgs prepare scan.h5 -o clean.h5 --steps sparks,dead,rings --set rings.window=11"}
GROUPS = {
    "prepare": {"Basics": ("output", "steps", "assignments", "as_json"), "Run": ("config", "device", "memory")}
}
_CONFIG = "TOML file of steps and their tables; the command line wins."
_SET = "An option of a step, as --set rings.window=11 (docs: prepare.md)."
_OPTIONS = {
    "steps": (Annotated[str | None, option(STEPS_HELP, DEFAULT_STEPS, metavar="NAME,...")], None),
    "config": (Annotated[Path | None, file_option(_CONFIG, "--config")], None),
    "assignments": (Annotated[list[str] | None, option(_SET, True, "--set", metavar="NAME=VALUE")], None),
    "device": (Device, None),
    "memory": (Memory, None),
}


@with_options("settings", _OPTIONS, settings_of)
def prepare_command(scan: Scan, output: Output, settings: Settings, as_json: AsJson = False) -> None:
    """Correct the effects of panel and beam in a scan: write line integrals and a mask, and print each step's numbers.

    The same steps are options of reconstruct; this command keeps the corrected scan. The default steps find out by
    themselves whether there is something to correct."""
    preprocessing = settings.preprocessing({"steps": DEFAULT_STEPS})
    with Ticker("step") as ticker, settings.naming_origins():
        ticker.stage(f"preparing {scan.name}")
        done, before = run_preparation(scan, output, preprocessing, settings.runtime, settings.config)
    if as_json:
        say_json({"scan": str(scan), "output": str(output), "steps": done, "steps_before": before})
    else:
        earlier = [f"done before  {', '.join(before)}"] if before else []
        say("\n".join([*earlier, *map(_line, done), str(output)]))


def _line(step: dict[str, Any]) -> str:
    numbers = {key: value for key, value in step.items() if key not in ("step", "options", "result")}
    return f"{step['step']:12s} {', '.join(filter(None, (step.get('result'), value_text(numbers, 4))))}"
