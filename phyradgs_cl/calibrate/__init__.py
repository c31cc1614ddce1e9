"""The true geometry and timing of a scan from its own frames, with how sure that is and what cannot be known."""

from phyradgs_cl.calibrate.finding import AGREES, CANNOT_TELL, CORRECTED, Calibration, Found
from phyradgs_cl.calibrate.run import calibrate

__all__ = ["AGREES", "CANNOT_TELL", "CORRECTED", "Calibration", "Found", "calibrate"]
