"""Converts volumes in Hounsfield units to attenuation in 1/mm, and refuses values that no attenuation has."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Hounsfield
from phyradgs_cl.fields.hounsfield import of_note
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.volume import Volume
from phyradgs_cl.text import plain_text

_LOWEST_PER_MM, _HIGHEST_PER_MM = -10.0, 1000.0  # values outside these limits are in HU: no noise is lower, no metal higher
_USUAL_PER_MM = 10.0  # if the user states water's attenuation, a value of larger size means HU, not 1/mm
VALUES = "values"
"""The provenance's key for the note that another program's file has about its values."""
FROM_HU = "1/mm, from HU"
"""The note of a volume that ``in_per_mm`` has converted."""
PER_MM = "in 1/mm"
"""The end of the note that exported files have about values in 1/mm, which may be of any size."""
log = logging.getLogger(__name__)


def check_attenuation(subject: str, volume: Volume, *, warn: bool = True) -> Volume:
    """Returns ``volume`` if it can be projected. Raises InputError about ``subject`` for values beyond 1e9 1/mm.
    Raises it also if negative values sum to at least as much as positive ones, as in Hounsfield units. Warns if negative
    values sum to more than a tenth of the positive ones, unless ``warn`` is False."""
    values = volume.values
    if (size := float(np.abs(values).max())) > h5.ATTENUATION.largest:
        expected = f"attenuation of at most {h5.ATTENUATION.largest:g} 1/mm"
        raise InputError(subject, f"a value of size {size:.3g}", expected, "correct the value or its unit")
    positive = float(np.sum(values, where=values > 0, dtype=np.float64))
    negative = float(-np.sum(values, where=values < 0, dtype=np.float64))
    found = f"values from {values.min():g} to {values.max():g}"
    expected = "attenuation: 0 in air, above 0 in matter"
    remedy = "of Hounsfield units it is µ(water) (1 + HU / 1000)"
    if positive <= negative:
        raise InputError(subject, found, expected, remedy)
    if warn and negative > 0.1 * positive:
        share = f"{100 * negative / positive:.0f} % as much below 0 as above"
        log.warning("%s: %s, %s; expected %s; %s", subject, found, share, expected, remedy)
    return volume


def in_per_mm(subject: str, volume: Volume, mu_water_per_mm: float | None = None) -> Volume:
    """Returns a volume in 1/mm, with the scale of the Hounsfield units that it had, if any. A file may state that values
    are in 1/mm, or in Hounsfield units, with a scale; or ``mu_water_per_mm`` states it. Where the file states nothing, it
    converts volumes with values beyond ±10 1/mm. Raises InputError about ``subject`` for noted Hounsfield units without
    scale."""
    stated = None if mu_water_per_mm is None else Hounsfield(mu_water_per_mm)
    note = str(volume.provenance.get(VALUES, ""))
    is_hu, scale = of_note(note)
    if scale is None and (is_hu or (not _is_per_mm(volume) and float(np.abs(volume.values).max()) > _USUAL_PER_MM)):
        scale = stated
    if scale is not None:
        facts = {**volume.provenance, **scale.facts(), VALUES: FROM_HU}
        return replace(volume, values=scale.per_mm(volume.values), provenance=facts)
    if is_hu:
        raise InputError(subject, "Hounsfield units", "1/mm", "say --mu-water-per-mm, near 0.02, to convert them")
    return volume


def words_of_hu(volumes: Mapping[Path, Volume], mu_water_per_mm: float | None = None) -> str:
    """Returns names and scales of the volumes that ``in_per_mm`` has converted, as the end of a line of output. Raises
    InputError for a ``mu_water_per_mm`` that none of them needed."""
    scales = {path: one.scale for path, one in volumes.items() if one.provenance.get(VALUES) == FROM_HU}
    if mu_water_per_mm is not None and Hounsfield(mu_water_per_mm) not in scales.values():
        found = f"{mu_water_per_mm:g} for {' and '.join(map(str, volumes))}"
        expected = "a volume in Hounsfield units that does not state its scale"
        raise InputError("--mu-water-per-mm", found, expected, "leave it out")
    return "".join(f", {plain_text(path.name)} from HU ({scale.line})" for path, scale in scales.items() if scale)


def attenuation_of(subject: str, volume: Volume) -> Volume:
    """Returns ``volume`` unchanged. Raises InputError about ``subject`` if its values cannot be in 1/mm, because they lie
    below −10 or above 1000, as Hounsfield units do, and the file does not state that they are in 1/mm."""
    lowest, highest = float(volume.values.min()), float(volume.values.max())
    if not _is_per_mm(volume) and (lowest < _LOWEST_PER_MM or highest > _HIGHEST_PER_MM):
        found = f"values from {lowest:g} to {highest:g}, as of Hounsfield units"
        raise InputError(subject, found, "attenuation in 1/mm", "say --mu-water-per-mm, near 0.02, to convert them")
    return volume


def _is_per_mm(volume: Volume) -> bool:
    """Returns whether the file states that its values are in 1/mm, or in a unit that was converted to it."""
    return volume.is_stated or PER_MM in str(volume.provenance.get(VALUES, ""))
