"""The true geometry and timing of a scan from its own frames, with deviations, and what the frames cannot determine."""

from phyradgs_cl.calibrate.result import AGREES, CANNOT_TELL, CORRECTED, Calibration, ParameterEstimate
from phyradgs_cl.calibrate.run import calibrate

__all__ = ["AGREES", "CANNOT_TELL", "CORRECTED", "Calibration", "ParameterEstimate", "calibrate"]
