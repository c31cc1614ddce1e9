"""info: what a file holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from phyradgs_cl.commands.console import say
from phyradgs_cl.commands.options import file_argument
from phyradgs_cl.workflow import summary

EXAMPLE = "Example: phyradgs info scan.h5"
_LONGEST = 2000


def info_command(
    file: Annotated[Path, file_argument("FILE", "Scan or volume file, or a volume as mha, nii, nrrd, npy, tiff.")],
) -> None:
    """Say what a file holds."""
    for key, value in summary(file).items():
        text = str(value)
        say(f"{key.replace('_', ' '):24s} {text[:_LONGEST]}{'…' if len(text) > _LONGEST else ''}")
