"""Where things stand in a scan file (a NeXus NXtomo entry; see docs on file formats)."""

DETECTOR = "instrument/detector"
SOURCE = "instrument/source"
SAMPLE = "sample"
EXTRA = "phyradgs"
KINEMATICS = f"{EXTRA}/kinematics"
POSES = f"{EXTRA}/poses"
GRID = f"{EXTRA}/grid"
REFERENCE = f"{EXTRA}/reference"

PROJECTION, FLAT, DARK, INVALID = 0, 1, 2, 3
QUANTITIES = ("attenuation", "transmission", "counts")
ROTATES = ("gantry", "sample")

# Standard fields that would move the geometry and that this package does not read.
IGNORED = (
    f"{DETECTOR}/transformations",
    f"{DETECTOR}/x_rotation_axis_pixel_position",
    f"{DETECTOR}/y_rotation_axis_pixel_position",
    f"{DETECTOR}/estimated_cor_from_motor",
    f"{DETECTOR}/x_flipped",
    f"{DETECTOR}/y_flipped",
    f"{SAMPLE}/transformations",
    f"{SAMPLE}/x_translation",
    f"{SAMPLE}/y_translation",
    f"{SAMPLE}/z_translation",
)
