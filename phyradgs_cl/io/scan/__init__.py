"""Reads and writes scan files, which are NeXus NXtomo entries in HDF5 (docs/formats.md). This module lists the addresses."""

DETECTOR = "instrument/detector"
DATA, MASK = f"{DETECTOR}/data", f"{DETECTOR}/pixel_mask"
SOURCE = "instrument/source"
SAMPLE = "sample"
EXTRA = "phyradgs"
BEAM = f"{EXTRA}/beam"
KINEMATICS = f"{EXTRA}/kinematics"
POSES = f"{EXTRA}/poses"
GRID = f"{EXTRA}/grid"
REFERENCE = f"{EXTRA}/reference"
TRUTH = f"{REFERENCE}/volume"
STATES, STATE_TIMES = f"{REFERENCE}/states", f"{REFERENCE}/state_times"
DEFORMATION = f"{REFERENCE}/deformation"
METAL = f"{EXTRA}/metal"
GATING = f"{EXTRA}/gating"
SIGNAL, PHASE, GATING_TIMES = f"{GATING}/signal", f"{GATING}/phase", f"{GATING}/time_s"

PROJECTION, FLAT, DARK, INVALID = 0, 1, 2, 3
QUANTITIES = ("attenuation", "transmission", "counts")
ROTATES = ("gantry", "sample")
BEAMS = ("cone", "parallel")

# Fields of NXtomo that would change the geometry. ``read_header`` does not read them, and warns of a file that has them.
IGNORED = (
    *(f"{DETECTOR}/{name}" for name in ("transformations", "x_rotation_axis_pixel_position")),
    *(f"{DETECTOR}/{name}" for name in ("y_rotation_axis_pixel_position", "estimated_cor_from_motor")),
    *(f"{DETECTOR}/{name}" for name in ("x_flipped", "y_flipped")),
    *(f"{SAMPLE}/{name}" for name in ("transformations", "x_translation", "y_translation", "z_translation")),
)
