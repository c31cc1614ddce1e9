"""Gating in scan files: a signal, or a phase, of every stored frame."""

import h5py
import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gating
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.hdf5.source import Hdf5Source
from phyradgs_cl.io.scan import schema


def read_gating(source: Hdf5Source, entry: str, used: np.ndarray, middle_s: np.ndarray) -> Gating | None:
    """Returns the signal or the phases of the projections, whose lines are open about ``middle_s`` (P,); None without them.
    used (F,): the stored frames that are projections."""
    if source.optional_group(f"{entry}/{schema.GATING}") is None:
        return None
    signal, phase = f"{entry}/{schema.SIGNAL}", f"{entry}/{schema.PHASE}"
    is_phase = source.optional(phase) is not None
    if is_phase and source.optional(signal) is not None:
        raise source.error(signal, "a signal beside a phase", "one of the two", "remove one of them")
    address = phase if is_phase else signal
    values = h5.read_array(source, address, used.shape, h5.PHASE if is_phase else None)[used]
    order = np.argsort(middle_s, kind="stable")
    try:
        return Gating(middle_s[order], values[order], is_phase)
    except InputError as error:
        expected = "frames at different times"
        raise source.error(address, f"{error.subject}: {error.found}", expected, "correct frame_start_time") from error


def write_gating(extra: h5py.Group, gating: Gating, middle_s: np.ndarray) -> None:
    """Writes the values at the middles of all stored frames ``middle_s`` (F,)."""
    group, values = h5.new_group(extra, "gating", "NXcollection"), gating.at(middle_s)
    h5.write_number(group, "phase" if gating.is_phase else "signal", values, "cycle" if gating.is_phase else None)
