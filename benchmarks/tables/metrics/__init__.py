"""Measures of the tables beside 3D PSNR and SSIM: projections, shapes of beads, bias of regions."""

from tables.metrics.beads import Bead
from tables.metrics.bias import regional_bias
from tables.metrics.edge import edge_sharpness
from tables.metrics.projections import compare_projections
from tables.metrics.roundness import roundness

__all__ = ["Bead", "compare_projections", "edge_sharpness", "regional_bias", "roundness"]
