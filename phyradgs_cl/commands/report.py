"""The commands report, which writes an HTML page about a reconstruction, and view, which opens a volume in napari."""

from pathlib import Path
from typing import Annotated

from phyradgs_cl.commands.console import file_argument, file_option, option, say
from phyradgs_cl.commands.options import Device, Output
from phyradgs_cl.report import view_volume, write_report
from phyradgs_cl.report.page import DEFAULT_VIEWS
from phyradgs_cl.settings import runtime_for

EXAMPLES = {
    "report": "Example: phyradgs report volume.h5 -o report.html",
    "view": "Example: phyradgs view volume.h5",
}
MOST_VIEWS = 24  # most frames on a page: more would make its file very large
_SCAN_DEFAULT = "the one that the volume file names, if unchanged"
_VIEWS = "Frames to compute from the volume and compare with the measurement."


def report_command(
    run: Annotated[Path, file_argument("RUN", "Volume file of a reconstruction.")], output: Output,
    scan: Annotated[Path | None, file_option("Its scan.", "--scan", default=_SCAN_DEFAULT)] = None,
    views: Annotated[int, option(_VIEWS, min=0, max=MOST_VIEWS)] = DEFAULT_VIEWS, device: Device = None,
) -> None:
    """Write one HTML page about a reconstruction: slices, convergence, projections, scan, provenance."""
    write_report(run, output, lambda: runtime_for(device), scan=scan, views=views)
    say(f"{output}: {output.stat().st_size / 1e6:.3g} MB")


def view_command(volume: Annotated[Path, file_argument("VOLUME", "Volume file.")]) -> None:
    """Open a volume in napari, if that is installed (pip install 'phyradgs-cl[view]')."""
    view_volume(volume)
