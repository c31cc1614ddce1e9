"""A bare NumPy array (.npy), and its grid as JSON beside it."""

import json
from pathlib import Path

import numpy as np

from phyradgs_cl.exporters.placed import Placed
from phyradgs_cl.io import written_beside


def write_npy(path: Path, volume: Placed) -> None:
    """Values (z, y, x) float32 in ``path``; what NumPy has no place for in the same name with .json."""
    facts = {
        "axes": ["z", "y", "x"],
        "shape": list(volume.values.shape),
        "voxel_size_mm": list(volume.spacing_mm[::-1]),
        "first_centre_mm": list(volume.origin_mm[::-1]),
        "values": volume.unit,
    }
    with written_beside(path.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        np.save(file, volume.values)  # which would add a suffix to a name
