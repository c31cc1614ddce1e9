"""Preparation of real scans: undoes effects of panels, beams and large objects in the frames, before any method."""

from phyradgs_cl.prepare.bad_pixels import find_dead
from phyradgs_cl.prepare.chain import DEFAULT_STEPS, PREPARED_KEY, STEP_FIELDS, STEPS, PrepareOptions, prepare
from phyradgs_cl.prepare.hardening import straighten, water_polynomial
from phyradgs_cl.prepare.light import flat_correction
from phyradgs_cl.prepare.phase import retrieve_phase
from phyradgs_cl.prepare.scatter import fit_scatter, remove_scatter
from phyradgs_cl.prepare.step import Model
from phyradgs_cl.prepare.stripes import remove_stripes

__all__ = [
    "DEFAULT_STEPS", "PREPARED_KEY", "STEPS", "STEP_FIELDS", "Model", "PrepareOptions", "find_dead", "fit_scatter",
    "flat_correction", "prepare", "remove_scatter", "remove_stripes", "retrieve_phase", "straighten", "water_polynomial"
]  # fmt: skip
