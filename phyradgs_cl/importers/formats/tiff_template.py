"""A template of the TOML for a folder of TIFFs: every key with its unit, and the values that the folder shows."""

import json
import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading import tiff
from phyradgs_cl.importers.reading.files import SafeFolder, in_natural_order
from phyradgs_cl.importers.reading.text import read_angles_rad

_KINDS = {"flats": r"flat|white", "darks": r"dark", "mask": r"mask"}  # what the names of such files contain
_WIDTH = 44  # of a line before its comment
# A line with a # in front is an example, which stands as a comment until the user wants it, or the folder shows the value.
_TEMPLATE = """
[frames]
# projections = "*.tif" # frames, in the order of the numbers in their names
# flats = "flat_*.tif" # frames without an object; with before and after in their names: interpolated
# darks = "dark_*.tif" # frames without a beam
# mask = "mask.tif" # non-zero: do not use the pixel
# order = 1 # the number in the names that gives the order, 1 the first; without it the import finds it
# image_key = "a.h5:/key" # of frames at an address in HDF5: 0 projection, 1 flat, 2 dark, 3 none of them
# axes = "v,frame,u" # order of such an array, here of sinograms; frame,v,u without it
# quantity = "counts" # or attenuation (line integrals), transmission
# flat_value = 50000.0 # counts without an object, in place of flats
# row_0 = "top" # or bottom: where the images' first row is
# column_0 = "left" # or right, seen from the source: where their first column is

[source]
to_axis_mm = 0.0 # mm, FILL IN: source to rotation axis
to_detector_mm = 0.0 # mm, FILL IN: source to detector
# beam = "parallel" # in place of both distances: a beam without a source at a distance

[detector]
# rows = 1 # of the images
# columns = 1 # of the images
pixel_size_v_mm = 0.0 # mm, FILL IN: height of a pixel, along the axis
pixel_size_u_mm = 0.0 # mm, FILL IN: width of a pixel
# offset_v_mm = 0.0 # mm, panel's middle above the central ray
# offset_u_mm = 0.0 # mm, panel's middle to the right of it, seen from the source
# lag = 0.0 # share of a frame that comes from the frames before

[angles]
# first_deg = 0.0 # degrees, angle of the first frame
# step_deg = 1.0 # degrees from frame to frame; FILL IN this, last_deg, values_deg or file
# last_deg = 359.0 # degrees, angle of the last frame
# values_deg = [0.0, 1.0] # degrees, one for each frame
# file = "angles.txt" # one angle a line, or an index and an angle
# unit = "deg" # or rad: of the file
# rotates = "gantry" # or sample: what turns, counterclockwise seen from above
# at = "start" # or middle of the exposure of the frame's first line

[timing]
# exposure_s = 0.06 # s, exposure of one line
# readout_s = 0.062 # s, in place of readout_ms
# frame_time_s = 0.0667 # s from frame to frame, in place of fps
# start_s = [0.0, 0.0667] # s, start of each frame, in place of fps
# detector_model = "intensity" # what an exposure averages: intensity, as real panels do, or log (line integrals)

[readout]
# fps = 15.0 # frames per second of a gantry that never stops; without it every frame is taken at rest
# readout_ms = 62.0 # ms from the first line's start to the last line's; 0: all lines at once
# first = "top" # or bottom, left, right, seen from the source: which line is read first
# axis = "rows" # or columns: what is read at one time, in place of first
# direction = -1 # 1: row 0 (lowest) or column 0 (left) first; -1: last; in place of first
# ratio = 1.0 # readout over exposure time, in place of readout_ms

# [beam]
# pulse_start = 0.0 # exposures after a frame's start: a beam that is not always on
# pulse_length = 1.0 # exposures

# [volume]
# shape = [256, 256, 256] # voxels z, y, x; without the table what a full turn sees
# size_mm = [200.0, 200.0, 200.0] # mm, z, y, x
# offset_mm = [0.0, 0.0, 0.0] # mm, z, y, x: the box's middle from the axis
"""


def template_of(path: Path) -> str:
    """Returns the TOML for a folder of TIFFs, which ``import`` refuses until it is filled in. InputError: no TIFFs."""
    if not (tiffs := SafeFolder(path).matching(*tiff.SUFFIXES)):
        remedy = "leave --template out: the other formats describe themselves"
        raise InputError(str(path), "no TIFF images", "a folder of them", remedy)
    patterns = _patterns(tiffs)
    projections = in_natural_order([file for file in tiffs if file.match(patterns["projections"])])
    frames, rows, columns = tiff.stack_shape(projections)
    text = _TEMPLATE
    for key, value in {**patterns, "rows": rows, "columns": columns, **_angles(path, frames)}.items():
        stated = json.dumps(value, ensure_ascii=False).replace("\\", r"\\")  # TOML writes words and numbers as JSON does
        text = re.sub(rf"^# {key} = .*?(?= # )", f"{key} = {stated}", text, flags=re.M)
    text = re.sub(r"^(.+ = .*?) # ", lambda line: f"{line[1]:<{_WIDTH}} # ", text, flags=re.M)
    head = f"# {frames} frames of {rows} × {columns} pixels. Fill in what says FILL IN, remove the # of a line that applies."
    return f"{head}\ntitle = {json.dumps(path.resolve().name, ensure_ascii=False)}\n{text.rstrip()}"


def _patterns(tiffs: list[Path]) -> dict[str, str]:
    """Returns a pattern of names for the projections, the largest series, and for flats, darks and mask."""
    names = [re.sub(r"\d+(?=\D*$)", "*", file.name) for file in tiffs]
    kind_of = {name: next((kind for kind, words in _KINDS.items() if re.search(words, name, re.I)), "") for name in names}
    found = {kind: name for name, kind in reversed(kind_of.items()) if kind}
    series = [name for name in names if not kind_of[name]]
    return {"projections": max(series, key=series.count) if series else "*.tif*", **found}


def _angles(folder: Path, frames: int) -> dict[str, str]:
    """Returns the text file of the folder with a number for every frame, and the likely unit of its numbers."""
    for file in SafeFolder(folder).matching(".txt", ".csv"):
        with suppress(InputError):
            values = read_angles_rad(file, frames, "rad")
            return {"file": file.name, "unit": "rad" if np.ptp(values) <= 2 * np.pi * (1 + 1e-3) else "deg"}
    return {}
