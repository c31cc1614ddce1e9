"""Options that several commands share, and the words that they take."""

from pathlib import Path
from typing import Annotated, Any, Literal

from phyradgs_cl.acquisition.readout import SIDES
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.commands.files import file_argument, file_option, option
from phyradgs_cl.prepare import DEFAULT_STEPS, STEPS
from phyradgs_cl.runtime import DEVICE_VARIABLE, MEMORY_VARIABLE
from phyradgs_cl.settings import numbers, pair_parser

LARGEST_MM = 1e6
Axis = Literal[AXES]  # type: ignore[valid-type]
First = Literal[SIDES]  # type: ignore[valid-type]
DetectorModel = Literal[DETECTOR_MODELS]  # type: ignore[valid-type]

Scan = Annotated[Path, file_argument("SCAN", "Scan file (HDF5, NXtomo).")]
Output = Annotated[Path, file_option("File to write; an existing one is replaced whole.", "--output", "-o")]
_DEVICE = (
    f"Device: index, cpu, gpu or part of a name (phyradgs devices), for ranks a list with commas; also ${DEVICE_VARIABLE}."
)
Device = Annotated[str | None, option(_DEVICE, "best by capability")]
_MEMORY = (
    f"Most device memory to take, such as 2GiB; volumes are then cut into bricks (docs: large.md). Also ${MEMORY_VARIABLE}."
)
Memory = Annotated[str | None, option(_MEMORY, "what the device has", metavar="SIZE")]

_STEPS = f"What to undo in the frames first, of {', '.join(STEPS)} (docs: prepare.md)."
STEPS_OF_PREPARE = option(_STEPS, DEFAULT_STEPS, metavar="NAME,...")
Steps = Annotated[str | None, option(_STEPS, "none", metavar="NAME,...")]

DETECTOR_OFFSET = "Shift V,U of the panel's centre, mm: V > 0 up (rows), U > 0 right (columns), seen from the source."

# where many runs are made
_SCHEDULER = "Dask scheduler to send the runs to: its address or its JSON file; local starts workers here."
Scheduler = Annotated[str | None, option(_SCHEDULER, metavar="ADDRESS|local")]
WorkerCount = Annotated[int | None, option("Local workers, each a process.", "one per device", metavar="N")]


def lengths(flag: str, help: str, default: str) -> Any:
    """An option that takes two lengths V,U."""
    parser = pair_parser(flag, "V,U in mm", "0,12.5", LARGEST_MM)
    return option(help, default, flag, parser=parser, metavar="V,U")


def pitches(flag: str, help: str, default: str) -> Any:
    """An option that takes the pitches of a pixel V,U, or one of a square pixel."""
    pair = pair_parser(flag, "V,U in mm, or one of square pixels", "0.148 or 0.3,0.15", LARGEST_MM)
    return option(help, default, flag, parser=lambda text: pair(text if "," in text else f"{text},{text}"), metavar="D|V,U")


def _numbers(help: str, metavar: str, *flags: str) -> Any:
    return option(help, "the scan's", *flags, parser=numbers, metavar=metavar)


# which voxels; Any, as the numbers are checked where they are used
_SIZE = "Voxels of the volume, of a single number along its longest side; the box stays as it is."
Size = Annotated[Any, _numbers(_SIZE, "N|Z,Y,X")]
VoxelMm = Annotated[Any, _numbers("Sides of a voxel, mm; the box stays.", "D|Z,Y,X")]
_ROI = "Box of the volume, mm about the axis, or its sides about the scan's middle; the voxels stay."
RoiMm = Annotated[Any, _numbers(_ROI, "D|Z,Y,X|Z0,Z1,Y0,Y1,X0,X1", "--roi-mm", "--roi")]
_MARGIN = "Voxels beyond the box, mm, that are reconstructed but not kept: for objects larger than box or panel."
MarginMm = Annotated[Any, option(_MARGIN, "0", parser=numbers, metavar="D|Z,Y,X")]
