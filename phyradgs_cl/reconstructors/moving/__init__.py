"""Reconstructs an object that moves in an unknown way: its motion signal in time, its displacement field, its volume."""

from collections.abc import Mapping
from typing import Any

# An object counts as moving if its field lowers the squared residual by over this fraction. Objects at rest reached 0.02.
# Breathing by a third of a voxel reached 0.06 and gained 1.2 dB in a scan with little noise; in a noisy scan 0.03 and 0 dB.
LEAST_GAIN = 0.03


def motion_line(found: Mapping[str, Any]) -> str:
    """Returns a line of text about the object's motion. found: the entry ``motion_found`` of a result's facts."""
    gain = f"squared residual {100 * found['gain']:.2g} % below that at rest"
    if not found["moves"]:
        if found["gain"] > LEAST_GAIN:
            gain += ", which a field's coefficients can explain without motion: take more views"
        return f"object at rest: no motion shown ({gain})"
    period_s = found["period_s"]
    follows = "following a signal" if period_s or found.get("follows") else "free in time"
    if period_s:
        follows += f" with a period of {period_s:.3g} s"
    return f"object moves by {found['rms_mm']:.3g} mm RMS, {follows}; {gain}"
