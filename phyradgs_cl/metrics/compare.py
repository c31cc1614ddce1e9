"""A volume against the truth: the numbers of the published tables."""

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.metrics.psnr import psnr
from phyradgs_cl.metrics.ssim import ssim


def compare(volume: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """psnr_db in dB, ssim (3D) and data_range, the maximum of ``reference``, of a volume against the truth, both (z, y, x).
    InputError: an empty reference, shapes that differ, NaN or infinity."""
    for name, values in {"volume": volume, "reference": reference}.items():
        if not isinstance(values, np.ndarray):
            found, remedy = type(values).__name__, "of a result or scan: its .volume or .reference"
            raise InputError(name, f"a {found}", "an array (z, y, x)", remedy)
    peak = float(reference.max())
    if peak <= 0:
        raise InputError("reference", f"a maximum of {peak:g}", "a volume with something in it")
    return {
        "psnr_db": psnr(volume, reference, peak),
        "ssim": ssim(volume, reference, peak),
        "data_range": peak,
    }
