"""Estimates a scan's true geometry and timing from its own frames, with standard deviations, and says which parameters the
frames cannot determine."""

from phyradgs_cl.calibrate.result import AGREES, CANNOT_TELL, CORRECTED, Calibration, ParameterEstimate
from phyradgs_cl.calibrate.run import calibrate

__all__ = ["AGREES", "CANNOT_TELL", "CORRECTED", "Calibration", "ParameterEstimate", "calibrate"]
