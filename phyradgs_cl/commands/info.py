"""info: what a file holds."""

import json
from pathlib import Path
from typing import Annotated

from phyradgs_cl.commands.console import AsJson, say
from phyradgs_cl.commands.files import file_argument
from phyradgs_cl.workflow import summary

EXAMPLE = "Example: phyradgs info scan.h5"
_LONGEST = 2000


def info_command(
    file: Annotated[Path, file_argument("FILE", "Scan or volume file, or a volume as mha, nii, nrrd, npy, tiff.")],
    as_json: AsJson = False,
) -> None:
    """Say what a file holds."""
    facts = summary(file)
    if as_json:
        say(json.dumps(facts, default=str))
        return
    for key, value in facts.items():
        text = str(value)
        say(f"{key.replace('_', ' '):24s} {text[:_LONGEST]}{'…' if len(text) > _LONGEST else ''}")
