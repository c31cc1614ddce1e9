"""TIFF as ImageJ writes it: a page per slice from the lowest up, row 0 the smallest y; sizes in mm, its origin in pixels."""

from pathlib import Path

from phyradgs_cl import checks
from phyradgs_cl.exporters.placed import Placed
from phyradgs_cl.io import written_beside

_MOST_BYTES = 4_000_000_000  # ImageJ's TIFF counts in 32 bits


def write_tiff(path: Path, volume: Placed) -> None:
    """One file of float32 pages; beyond 4 GB a BigTIFF, which ImageJ opens through Bio-Formats."""
    tifffile = checks.package("tifffile", "the package that this export needs", "phyradgs-cl[formats]")
    dx, dy, dz = volume.spacing_mm
    origin = [-place / step for place, step in zip(volume.origin_mm, volume.spacing_mm, strict=True)]
    facts = {
        "axes": "ZYX",
        "spacing": dz,
        "unit": "mm",
        "min": float(volume.values.min()),
        "max": float(volume.values.max()),
        **{f"{axis}origin": place for axis, place in zip("xyz", origin, strict=True)},
        "Info": f"values in {volume.unit}",
    }
    small = volume.values.nbytes < _MOST_BYTES
    with written_beside(path) as temporary:
        tifffile.imwrite(
            temporary,
            volume.values,
            imagej=small,
            bigtiff=not small,
            resolution=(1 / dx, 1 / dy),
            resolutionunit="NONE",
            metadata=facts,
            photometric="minisblack",
        )
