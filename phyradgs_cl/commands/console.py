"""What a command says: results on stdout, one line about trouble on stderr, and the status it ends with."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

import typer

from phyradgs_cl.errors import OutputError


def say(text: str) -> None:
    """One result on stdout."""
    try:
        typer.echo(text)
    except BrokenPipeError:  # nobody reads on, as after `| head`: no error, and no reason to stop
        give_up_stdout()
    except OSError as error:
        give_up_stdout()
        found = error.strerror or str(error)
        raise OutputError("standard output", found, "somewhere with room to write to") from error


def complain(text: str, status: int = 2) -> int:
    """One line on stderr; the exit status to end with."""
    with suppress(OSError):  # nobody is left to be told
        typer.echo("phyradgs: " + " ".join(text.split()), err=True)
    return status


def remark(text: str) -> None:
    """One line on stderr that is neither a result nor trouble."""
    with suppress(OSError):
        typer.echo(text, err=True)


def give_up_stdout() -> None:
    """What could not be written would be tried again at the interpreter's end, with a traceback."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
