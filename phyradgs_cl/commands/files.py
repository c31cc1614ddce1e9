"""File names as words of a command."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer

from phyradgs_cl.errors import InputError


def file_parser(culprit: str) -> Callable[[str], Path]:
    """Reads the file name given for ``culprit``; an empty one would pass for the current folder."""

    def file(text: str) -> Path:
        if not text.strip():
            raise InputError(culprit, repr(text), "a file name", "name a file")
        return Path(text)

    return file


def file_option(*names: str, help: str, show_default: bool | str = True) -> Any:
    """An option that takes a file name."""
    parser = file_parser(names[-1])
    return typer.Option(*names, parser=parser, metavar="FILE", help=help, show_default=show_default)


def file_argument(name: str, help: str) -> Any:
    """An argument that is a file name."""
    return typer.Argument(parser=file_parser(name), metavar=name, help=help)
