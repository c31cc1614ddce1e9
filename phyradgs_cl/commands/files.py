"""How commands declare their options and arguments."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer

from phyradgs_cl.errors import InputError


def option(help: str, default: bool | str = True, *flags: str, **more: Any) -> Any:
    """An option of Typer: what its help says, and what that calls the default where it is not the value itself."""
    return typer.Option(*flags, help=help, show_default=default, **more)


def file_parser(subject: str) -> Callable[[str], Path]:
    """Reads the file name given for ``subject``; an empty one would pass for the current folder."""

    def file(text: str) -> Path:
        if not text.strip():
            raise InputError(subject, repr(text), "a file name", "name a file")
        return Path(text)

    return file


def file_option(help: str, *flags: str, default: bool | str = True) -> Any:
    """An option that takes a file name."""
    return option(help, default, *flags, parser=file_parser(flags[-1]), metavar="FILE")


def file_argument(name: str, help: str) -> Any:
    """An argument that is a file name."""
    return typer.Argument(parser=file_parser(name), metavar=name, help=help)
