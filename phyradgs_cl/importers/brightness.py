"""Makes frames comparable that got more light than others, in HDF5: flats of another exposure, and a monitor of the beam."""

import logging
from dataclasses import replace

import numpy as np

from phyradgs_cl.importers.frames import median
from phyradgs_cl.importers.hdf5 import Reading, Stacks

_log = logging.getLogger(__name__)
_LIKE = 0.01  # exposures whose relative difference is smaller are measured ones of one setting
_LARGEST = 10.0  # a monitor whose largest reading exceeds its smallest by this factor measures something else


def evened(stacks: Stacks, exposure: Reading | None, monitor: Reading | None, remedy: str = "") -> Stacks:
    """Returns stacks whose flats have the light of one beam in the projections' exposure, and whose projections' light is
    stated relative to that. monitor: readings of the beam. remedy: how to leave it out."""
    longer = _longer(stacks, exposure)
    flats, frames = _monitored(stacks, monitor, longer, remedy)
    if np.any(flats != 1):
        dark = median(stacks.darks) if len(stacks.darks) else 0.0
        stacks = replace(stacks, flats=np.float32(dark + (stacks.flats - dark) / flats[:, None, None]))
    return replace(stacks, light=frames)


def _longer(stacks: Stacks, exposure: Reading | None) -> np.ndarray:
    """Returns the flats' exposures as multiples of the projections' (n,); 1 where the file states none, or unlike ones of
    the projections."""
    alike = np.ones(len(stacks.flats))
    if exposure is None or not _is_sane(stacks, exposure) or len(alike) == 0:
        return alike
    usual = np.median(exposure.projections)
    longer = exposure.flats / usual
    if np.ptp(exposure.projections) > 2 * _LIKE * usual or np.abs(longer - 1).max() <= _LIKE:
        return alike
    text = "%s: flats are exposed %s times as long as projections: divided by that above the darks, which stay as they are"
    _log.warning(text, exposure.name, _range(longer))
    return longer


def _monitored(
    stacks: Stacks, monitor: Reading | None, longer: np.ndarray, remedy: str
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the light of flats (n,) and projections (P,), 1 in the flats' beam and a projection's exposure. longer: see
    ``_longer``."""
    alike = longer, np.ones(len(stacks.projections))
    if monitor is None:
        return alike
    both = np.concatenate([monitor.flats, monitor.projections])
    if not _is_sane(stacks, monitor) or both.max() > _LARGEST * both.min():
        text = "%s is not used: it lacks a number above 0 for each flat and projection, or they differ by a factor above %g"
        _log.warning(text, monitor.name, _LARGEST)
        return alike
    reference = monitor.flats if len(monitor.flats) else monitor.projections
    flats, frames = (one / np.median(reference) for one in (monitor.flats, monitor.projections))
    said, usual = _range(frames), float(np.median(longer)) if len(longer) else 1.0
    if abs(np.log(np.median(frames) * usual)) < abs(np.log(np.median(frames))):  # counts, which grow with the exposure
        flats, frames = flats * usual, frames * usual
    else:  # a rate, such as the ring's current
        flats = flats * longer
    if np.ptp(both) > 0:
        _log.warning("%s: frames are divided by it (%s of the flats'); %s to leave it out", monitor.name, said, remedy)
    return flats, frames


def _is_sane(stacks: Stacks, reading: Reading) -> bool:
    """Returns whether there is a number above 0 for each flat and each projection."""
    parts = (reading.flats, len(stacks.flats)), (reading.projections, len(stacks.projections))
    return all(len(one) == count and bool(np.all(np.isfinite(one) & (one > 0))) for one, count in parts)


def _range(values: np.ndarray) -> str:
    return " to ".join(dict.fromkeys(f"{value:.4g}" for value in (values.min(), values.max())))
