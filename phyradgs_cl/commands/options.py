"""Options that several commands share, and the words that they take."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from phyradgs_cl.runtime import DEVICE_VARIABLE
from phyradgs_cl.settings import file_parser


class Axis(str, Enum):
    rows = "rows"
    columns = "columns"


class DetectorModel(str, Enum):
    log = "log"
    intensity = "intensity"


def file_option(*names: str, help: str, show_default: bool | str = True) -> Any:
    """An option that takes a file name."""
    parser = file_parser(names[-1])
    return typer.Option(*names, parser=parser, metavar="FILE", help=help, show_default=show_default)


def file_argument(name: str, help: str) -> Any:
    """An argument that is a file name."""
    return typer.Argument(parser=file_parser(name), help=help)


Device = Annotated[
    str | None,
    typer.Option(
        help=f"OpenCL device: index, cpu, gpu or part of a name (see 'phyradgs devices'); also ${DEVICE_VARIABLE}.",
        show_default="best by capability",
    ),
]
Output = Annotated[
    Path,
    file_option("--output", "-o", help="File to write; an existing one is replaced whole."),
]
