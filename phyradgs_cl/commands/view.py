"""view: a volume in a window."""

from pathlib import Path
from typing import Annotated

from phyradgs_cl.commands.files import file_argument
from phyradgs_cl.report import view_volume

EXAMPLE = "Example: phyradgs view volume.h5"


def view_command(volume: Annotated[Path, file_argument("VOLUME", "Volume file.")]) -> None:
    """Open a volume in napari, if that is installed (pip install 'napari[all]')."""
    view_volume(volume)
