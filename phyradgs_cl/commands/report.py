"""report: a reconstruction as an HTML page."""

from pathlib import Path
from typing import Annotated

from phyradgs_cl.commands.console import say
from phyradgs_cl.commands.files import file_argument, file_option, option
from phyradgs_cl.commands.options import Device, Output
from phyradgs_cl.report import write_report
from phyradgs_cl.report.page import DEFAULT_VIEWS
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import device_wish

EXAMPLE = "Example: phyradgs report volume.h5 -o report.html"
MOST_VIEWS = 24


def report_command(
    run: Annotated[Path, file_argument("RUN", "Volume file of a reconstruction.")],
    output: Output,
    scan: Annotated[
        Path | None,
        file_option("Its scan.", "--scan", default="the one that the volume file names, if unchanged"),
    ] = None,
    views: Annotated[
        int,
        option("Frames to compute from the volume and compare with the measurement.", min=0, max=MOST_VIEWS),
    ] = DEFAULT_VIEWS,
    device: Device = None,
) -> None:
    """Write one HTML page about a reconstruction: slices, convergence, projections, scan, provenance."""
    wish = device_wish(device)
    write_report(run, output, lambda: Runtime(wish), scan=scan, views=views)
    say(f"{output}: {output.stat().st_size / 1e6:.3g} MB")
