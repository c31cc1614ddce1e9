"""info: what a file holds."""

import json
from pathlib import Path
from typing import Annotated, Any

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
        text = _shown(value)
        say(f"{key.replace('_', ' '):24s} {text[:_LONGEST]}{'…' if len(text) > _LONGEST else ''}")


def _shown(value: Any, is_inside: bool = False) -> str:
    """A value in words, its numbers to six digits."""
    match value:
        case float():
            return f"{value:.6g}"
        case tuple():
            return f"({', '.join(_shown(part, True) for part in value)})"
        case list():
            return f"[{', '.join(_shown(part, True) for part in value)}]"
        case dict():
            return f"{{{', '.join(f'{key!r}: {_shown(part, True)}' for key, part in value.items())}}}"
    return repr(value) if is_inside else str(value)
