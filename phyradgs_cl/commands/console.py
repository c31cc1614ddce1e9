"""What all commands share: makers of options and arguments, printing, exit statuses, help, and ranks under mpiexec."""

import json
import math
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from phyradgs_cl import signals
from phyradgs_cl.checks import short_repr
from phyradgs_cl.errors import InputError, OutputError, PhyradgsError
from phyradgs_cl.parallel import launched
from phyradgs_cl.removed import removal
from phyradgs_cl.text import plain_text

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def numbers(text: str) -> float | list[float] | str:
    """Parses a number, or several with commas between. Returns other text unchanged, which a later check refuses."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        return text
    return values if len(values) > 1 else values[0]


def option(help: str, default: bool | str = True, *flags: str, **more: Any) -> Any:
    """Returns a Typer option with its help. default: what the help shows as the default. True shows its value, a text is
    shown in its place, and False shows nothing."""
    return typer.Option(*flags, help=help, show_default=default, **more)


def file_option(help: str, *flags: str, default: bool | str = True) -> Any:
    return option(help, default, *flags, parser=file_parser(flags[-1]), metavar="FILE")


def file_argument(name: str, help: str) -> Any:
    return typer.Argument(parser=file_parser(name), metavar=name, help=help)


def pair_option(form: str, example: str, metavar: str, largest: float = math.inf) -> Callable[[str, str, Any], Any]:
    """Returns a function (flag, help, default) that makes an option of two numbers. Other arguments: as in ``pair_of``."""
    return lambda flag, help, default: option(
        help, default, flag, parser=pair_of(flag, form, example, largest), metavar=metavar
    )


def pair_of(
    flag: str, form: str, example: str, largest: float = math.inf
) -> Callable[[str], tuple[float, float]]:
    """Returns a parser of two numbers with a comma between, each at most ``largest`` in size. The parser raises InputError
    about ``flag`` for other text; the message shows ``form``, and an ``example`` if the text is not two numbers."""

    def pair(text: str) -> tuple[float, float]:
        try:
            first, second = (float(part) for part in text.split(","))
        except ValueError:
            raise InputError(flag, repr(text), f"two numbers {form}", f"write for example {example}") from None
        if not all(math.isfinite(x) and abs(x) <= largest for x in (first, second)):
            raise InputError(flag, repr(text), f"two numbers {form}, of at most {largest:g}")
        return first, second

    return pair


def file_parser(subject: str) -> Callable[[str], Path]:
    """Returns a parser of paths. It raises InputError about ``subject`` for an empty name, which Path takes as "."."""

    def file(text: str) -> Path:
        if not text.strip():
            raise InputError(subject, repr(text), "a file name", "name a file")
        return Path(text)

    return file


def say_json(facts: Mapping[str, object]) -> None:
    """Prints facts on stdout as one line of JSON, with null for NaN and infinity, which JSON lacks. Raises OutputError."""
    say(json.dumps(json.loads(json.dumps(facts, default=str), parse_constant=lambda name: None)))


def say(text: str) -> None:
    """Prints a result on stdout. Raises OutputError if that fails. A pipe that its reader has closed is no error."""
    try:
        typer.echo(plain_text(text))
    except BrokenPipeError:  # the reader has ended early, as `| head` does
        give_up_stdout()
    except OSError as error:
        give_up_stdout()
        found = error.strerror or str(error)
        raise OutputError("standard output", found, "somewhere with room to write to") from error


def complain(text: str, status: int = 2) -> int:
    """Prints an error on stderr in one line. Returns ``status``, the exit status."""
    remark("phyradgs: " + " ".join(text.split()))
    return status


def remark(text: str) -> None:
    with suppress(OSError):
        typer.echo(plain_text(text), err=True)


def give_up_stdout() -> None:
    """Discards output not yet written. Otherwise Python, as it ends, would try to write it, and print a traceback."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def scores(metrics: Mapping[str, float | None]) -> str:
    """Returns a run's metrics, and its errors on held-out pixels, as text with a comma before each."""
    from phyradgs_cl.metrics import HELD_OUT  # imported here, because it loads SciPy, which takes time

    return "".join(f", {words}" for words in [*told(metrics), *told(metrics, HELD_OUT)])


def told(metrics: Mapping[str, object], *names: Any) -> list[str]:
    """Returns the metrics that are present as texts such as "PSNR 31.20 dB". names: which; by default ``METRICS``."""
    from phyradgs_cl.metrics import printed  # imported here, because it loads SciPy, which takes time

    return [f"{title} {value}" for title, value in printed(metrics, *names)]


def usage_text(error: Any, arguments: Sequence[str]) -> str:
    """Returns Typer's message ``error`` about wrong ``arguments``, with the value that Typer could not read. For an option
    or a value of an earlier version, returns what to write instead."""
    flag, param = str(getattr(error, "option_name", "")), getattr(error, "param", None)
    value = _value_of(param, arguments)
    words = [(flag, ""), (flag.lstrip("-").replace("-", "_"), flag)]
    words += [(f"{name} {value}", "") for name in getattr(param, "opts", ())]
    for left in filter(None, (removal(*word) for word in words)):
        return str(left)
    text = str(error.format_message()).replace("Value error, ", "")
    return text if value is None or repr(value) in text else f"{text.rstrip('.')}; found {short_repr(value)}"


def _value_of(parameter: Any, arguments: Sequence[str]) -> str | None:
    for flag in (name for name in getattr(parameter, "opts", ()) if name.startswith("-")):
        for word, following in zip(arguments, [*arguments[1:], None], strict=True):
            if word == flag:
                return following
            if word.startswith(f"{flag}="):
                return word.removeprefix(f"{flag}=")
    return None


_KINDS = {" <Path>": "", " <path>": " PATH", " <str>": " TEXT", " <list[str]>": " TEXT"}
_KINDS |= {" <int>": " N", " <int range>": " N", " <float>": " NUMBER"}
"""Names of types in Typer's help, and the words that are shown instead."""


class GroupedCommand(TyperCommand):
    """A command whose help lists options under headings. groups: the names of the parameters under each heading. Options in
    no group are listed under "Options"; ``--help`` ends the first group."""

    groups: Mapping[str, Sequence[str]] = {}

    def format_options(self, ctx: Any, formatter: Any) -> None:
        headings = {name: heading for heading, names in self.groups.items() for name in names}
        order = list(headings)
        headings["help"] = next(iter(self.groups), "Options")
        sections: dict[str, list[tuple[str, str]]] = {name: [] for name in ("Arguments", "Options", *self.groups)}
        for parameter in sorted(self.get_params(ctx), key=lambda p: order.index(p.name) if p.name in order else len(order)):
            usual = "Arguments" if parameter.param_type_name == "argument" else "Options"
            if (record := parameter.get_help_record(ctx)) is not None:
                name, text = record
                for kind, word in _KINDS.items():
                    name = name.replace(kind, word)
                sections[headings.get(parameter.name or "", usual)].append((name, text))
        for name, records in sections.items():
            if records:
                with formatter.section(name):
                    formatter.write_dl(records)


def takes_part(arguments: Sequence[str]) -> bool:
    """Returns whether this process takes part in the command. Under mpiexec, ranks other than 0 take part in ``reconstruct``
    only, and this function turns off their output."""
    if launched().rank == 0:
        return True
    sys.stdout = sys.stderr = None  # libraries check for None, which programs without a console have here
    return arguments[:1] == ["reconstruct"]  # all other commands run on rank 0 only


def last_words(error: BaseException) -> int:
    """Prints the error because of which this rank ends all ranks, and returns the exit status."""
    rank = launched().rank
    if isinstance(error, KeyboardInterrupt):
        text, status = signals.farewell(), signals.exit_status()
    elif isinstance(error, PhyradgsError):
        text, status = str(error), error.exit_code
    else:
        text, status = "".join(traceback.format_exception(error)), 1
    with suppress(OSError):
        os.write(2, f"phyradgs: {f'rank {rank}: ' if rank else ''}{text}\n".encode())
    return status
