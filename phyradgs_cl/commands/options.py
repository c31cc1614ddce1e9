"""Options that several commands share, and the words that they take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.commands.files import file_argument, file_option
from phyradgs_cl.reconstructors import METHODS
from phyradgs_cl.runtime import DEVICE_VARIABLE, MEMORY_VARIABLE
from phyradgs_cl.settings import numbers, pair_parser

LARGEST_MM = 1e6
MotionName = Literal["static", "static-start", "micro-views", "per-row", "exact"]
Axis = Literal[AXES]  # type: ignore[valid-type]
DetectorModel = Literal[DETECTOR_MODELS]  # type: ignore[valid-type]

Scan = Annotated[Path, file_argument("SCAN", "Scan file (HDF5, NXtomo).")]
Device = Annotated[
    str | None,
    typer.Option(
        help=f"OpenCL device: index, cpu, gpu or part of a name (see 'phyradgs devices'), or a list with commas for ranks; "
        f"also ${DEVICE_VARIABLE}.",
        show_default="best by capability",
    ),
]
Output = Annotated[
    Path,
    file_option("--output", "-o", help="File to write; an existing one is replaced whole."),
]
Memory = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        help="Most device memory to take, such as 2GiB or 500M; what can be cut then works in bricks "
        f"(docs: large.md). Also ${MEMORY_VARIABLE}.",
        show_default="what the device has",
    ),
]

RANKS = "Under mpiexec (docs: cluster.md)"
"""What the help of a command calls its options for ranks, which stand at its end."""

# where many runs are made
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS|local",
        help="Dask scheduler to send the runs to: its address or its JSON file; local starts workers here.",
    ),
]
WorkerCount = Annotated[
    int | None, typer.Option(metavar="N", help="Local workers, each a process.", show_default="one per device")
]



def lengths(option: str, help: str, show_default: str) -> Any:
    """An option that takes two lengths V,U."""
    parser = pair_parser(option, "V,U in mm", "0,12.5", LARGEST_MM)
    return typer.Option(option, parser=parser, metavar="V,U", help=help, show_default=show_default)


# which voxels; Any, as the numbers are checked where they are used
Size = Annotated[
    Any,
    typer.Option(
        parser=numbers,
        metavar="N|Z,Y,X",
        help="Voxels of the volume, of a single number along its longest side; the box stays as it is.",
        show_default="the scan's",
    ),
]
VoxelMm = Annotated[
    Any,
    typer.Option(
        parser=numbers,
        metavar="D|Z,Y,X",
        help="Sides of a voxel, mm; the box stays as it is, but for whole voxels.",
        show_default="the scan's",
    ),
]
RoiMm = Annotated[
    Any,
    typer.Option(
        "--roi-mm",
        "--roi",
        parser=numbers,
        metavar="Z0,Z1,Y0,Y1,X0,X1",
        help="Box of the volume, mm about the axis; the voxels stay as they are.",
        show_default="the scan's",
    ),
]

# what a reconstruction is asked for; commands that speak of one share these words
Method = Annotated[
    str | None,
    typer.Option(
        metavar=f"{'|'.join(METHODS)}|MODULE:NAME",
        help="phyradgs: exact splats; r2: R2-Gaussian's affine splats; fdk: analytic; "
        "naf, sax-nerf: neural fields; MODULE:NAME: a function of your own (docs: api.md); "
        "the others are iterative on voxels.",
        show_default="phyradgs",
    ),
]
MotionModel = Annotated[
    MotionName | None,
    typer.Option(
        help="How frames see the moving gantry: frozen at mid-window (static), at the start, M×N micro-views, "
        "every line at its own times (per-row), or splats that move while lines integrate (exact); "
        "not every method has all of them.",
        show_default="exact for phyradgs, else static",
    ),
]
Strips = Annotated[
    int | None,
    typer.Option(help="Strips M of a frame (rolling shutter); means micro-views.", show_default="8"),
]
SubIntervals = Annotated[
    int | None,
    typer.Option(
        help="Sub-intervals N of an exposure (motion blur); for phyradgs means micro-views.",
        show_default="5",
    ),
]
Segments = Annotated[
    int | None,
    typer.Option(help="Segments of a frame (motion exact); 0: by the time error.", show_default="0"),
]
TimeError = Annotated[
    float | None,
    typer.Option(
        help="Relative error that averaging over time may leave (motion exact).", show_default="0.005"
    ),
]
Iterations = Annotated[
    int | None,
    typer.Option(
        help="Iterations: one frame each for splats, all frames for voxels.",
        show_default="preset's: 3000 for splats",
    ),
]
GaussianCount = Annotated[
    int | None, typer.Option(help="Gaussians at the start.", show_default="preset's: from the grid")
]
Batch = Annotated[
    int | None,
    typer.Option(
        metavar="B",
        help="Frames per step, for splats.",
        show_default="as many as ranks",
        rich_help_panel=RANKS,
    ),
]
Seed = Annotated[
    int | None, typer.Option(help="Seed of cloud, frame order and sub-volumes.", show_default="0")
]
Preset = Annotated[
    str | None,
    typer.Option(
        help="Constants: default, quick, paper or released (phyradgs); published (r2); the window of fdk.",
        show_default="the method's first",
    ),
]
Config = Annotated[
    Path | None,
    file_option(
        "--config",
        help="TOML file of options (underscores for dashes; docs: formats.md) and the method's constants; "
        "the command line wins.",
    ),
]
Assignments = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Any option of the method by name, as in the file: --set tv_weight=0.002 --set order=random. "
        "Docs: methods.md.",
    ),
]
LineModel = Annotated[
    DetectorModel | None,
    typer.Option(
        help="What is averaged over an exposure: line integrals (log) or intensity.",
        show_default="the scan's",
    ),
]
IgnoreLag = Annotated[
    bool, typer.Option("--ignore-lag", help="Leave the lag that the scan file states in the frames.")
]
MedianFilter = Annotated[
    int | None,
    typer.Option(help="Median filter of the frames: 3 or 5 pixels per side, 0 none.", show_default="0"),
]
