"""What a command says: results on stdout, one line about trouble on stderr, its status, and its help."""

import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from phyradgs_cl.errors import OutputError
from phyradgs_cl.text import plain_text

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def say(text: str) -> None:
    """One result on stdout."""
    try:
        typer.echo(plain_text(text))
    except BrokenPipeError:  # nobody reads on, as after `| head`: no error, and no reason to stop
        give_up_stdout()
    except OSError as error:
        give_up_stdout()
        found = error.strerror or str(error)
        raise OutputError("standard output", found, "somewhere with room to write to") from error


def complain(text: str, status: int = 2) -> int:
    """One line on stderr; the exit status to end with."""
    with suppress(OSError):  # nobody is left to be told
        typer.echo("phyradgs: " + plain_text(" ".join(text.split())), err=True)
    return status


def scores(metrics: Mapping[str, float | None]) -> str:
    """Returns the metrics of a run, and its errors on held-out pixels, with a comma before each."""
    from phyradgs_cl.metrics import HELD_OUT, printed

    words = [*printed(metrics), *printed(metrics, HELD_OUT)]
    return "".join(f", {title} {value}" for title, value in words)


def usage_text(error: Any, arguments: Sequence[str]) -> str:
    """What Typer found wrong with the words of a command, with the value that it could not read."""
    text = str(error.format_message()).replace("Value error, ", "")
    from phyradgs_cl.checks import shown

    value = _value_of(getattr(error, "param", None), arguments)
    return text if value is None or repr(value) in text else f"{text.rstrip('.')}; found {shown(value)}"


def _value_of(parameter: Any, arguments: Sequence[str]) -> str | None:
    """The word that was given for an option; None for an argument, whose place only Typer knows."""
    for flag in (name for name in getattr(parameter, "opts", ()) if name.startswith("-")):
        for word, following in zip(arguments, [*arguments[1:], None], strict=True):
            if word == flag:
                return following
            if word.startswith(f"{flag}="):
                return word.removeprefix(f"{flag}=")
    return None


def remark(text: str) -> None:
    """One line on stderr that is neither a result nor trouble."""
    with suppress(OSError):
        typer.echo(plain_text(text), err=True)


def give_up_stdout() -> None:
    """What could not be written would be tried again at the interpreter's end, with a traceback."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


class PanelledCommand(TyperCommand):
    """A command whose help lists its options under the headings of ``groups``, heading: names of parameters. ``help`` comes
    last under the first heading, what no group names under "Options"."""

    groups: Mapping[str, Sequence[str]] = {}

    def format_options(self, ctx: Any, formatter: Any) -> None:
        headings = {name: heading for heading, names in self.groups.items() for name in names}
        order = list(headings)
        headings["help"] = next(iter(self.groups), "Options")
        panels: dict[str, list[tuple[str, str]]] = {name: [] for name in ("Arguments", "Options", *self.groups)}
        for parameter in sorted(self.get_params(ctx), key=lambda p: order.index(p.name) if p.name in order else len(order)):
            usual = "Arguments" if parameter.param_type_name == "argument" else "Options"
            if (record := parameter.get_help_record(ctx)) is not None:
                panels[headings.get(parameter.name or "", usual)].append(record)
        for name, records in panels.items():
            if records:
                with formatter.section(name):
                    formatter.write_dl(records)
