"""Real scans: what panels, beams and large objects do to frames, undone before any method. A step a file, with its
reference."""

from phyradgs_cl.prepare.air import find_air
from phyradgs_cl.prepare.chain import DEFAULT_STEPS, STEP_FIELDS, STEPS, TOLD, PrepareOptions, prepare
from phyradgs_cl.prepare.dead import find_dead
from phyradgs_cl.prepare.flats import flat_correction
from phyradgs_cl.prepare.hardening import fit_polynomial, straighten, water_polynomial
from phyradgs_cl.prepare.rings import ring_pattern, ring_strength
from phyradgs_cl.prepare.scatter import fit_scatter, remove_scatter
from phyradgs_cl.prepare.sparks import find_sparks
from phyradgs_cl.prepare.step import Model

__all__ = [
    "DEFAULT_STEPS", "STEPS", "STEP_FIELDS", "TOLD", "Model", "PrepareOptions", "find_air", "find_dead",
    "find_sparks", "fit_polynomial", "fit_scatter", "flat_correction", "prepare", "remove_scatter",
    "ring_pattern", "ring_strength", "straighten", "water_polynomial"
]  # fmt: skip
