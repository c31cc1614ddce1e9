"""The paper's own numbers, printed beside ours as a reference. Their data, volumes and hardware differ.

They are from PhyRadGS, Tables 1 and 2: PSNR in dB, SSIM and minutes on an RTX 4090."""

from typing import NamedTuple


class Published(NamedTuple):
    """One cell of the paper's tables. A number that the paper lacks is None."""

    psnr_db: float
    ssim: float
    minutes: float | None


TABLE1: dict[str, dict[str, Published]] = {
    "FDK": {
        "rapid": Published(18.01, 0.090, None),
        "standard": Published(20.72, 0.152, None),
        "phantom": Published(30.04, 0.794, None),
    },
    "ASD-POCS": {
        "rapid": Published(27.99, 0.777, 0.38),
        "standard": Published(30.94, 0.834, 0.73),
        "phantom": Published(30.29, 0.844, 9.80),
    },
    "NAF": {
        "rapid": Published(28.18, 0.776, 11.56),
        "standard": Published(30.96, 0.844, 12.30),
        "phantom": Published(27.52, 0.779, 163.60),
    },
    "SAX-NeRF": {"rapid": Published(28.02, 0.773, 61.39), "standard": Published(30.62, 0.849, 115.84)},
    "R2-Gaussian": {
        "rapid": Published(28.93, 0.828, 7.95),
        "standard": Published(32.12, 0.889, 7.99),
        "phantom": Published(35.12, 0.852, 18.83),
    },
    "PhyRadGS w/o ST": {
        "rapid": Published(29.00, 0.834, 3.13),
        "standard": Published(31.96, 0.891, 3.31),
        "phantom": Published(35.13, 0.855, 4.68),
    },
    "R2-Gaussian w/ ST": {
        "rapid": Published(31.22, 0.866, 19.37),
        "standard": Published(33.97, 0.909, 20.15),
        "phantom": Published(36.84, 0.861, 50.78),
    },
    "PhyRadGS": {
        "rapid": Published(31.23, 0.871, 5.16),
        "standard": Published(33.54, 0.910, 5.31),
        "phantom": Published(37.43, 0.862, 9.15),
    },
}
TABLE2: dict[str, dict[str, Published]] = {
    "M=1 N=5": {"rapid": Published(29.79, 0.851, 3.98)},
    "M=4 N=5": {"rapid": Published(30.62, 0.869, 4.52)},
    "M=8 N=5": {"rapid": Published(31.22, 0.871, 5.16)},
    "M=16 N=5": {"rapid": Published(31.53, 0.884, 6.84)},
    "M=8 N=1": {"rapid": Published(29.27, 0.848, 3.14)},
    "M=8 N=3": {"rapid": Published(31.16, 0.870, 3.98)},
    "M=8 N=7": {"rapid": Published(31.21, 0.873, 6.18)},
}


def published(label: str, column: str) -> Published | None:
    """Returns the paper's cell of a row in the column "rapid", "standard" or "phantom"; None where it has none."""
    return {**TABLE1, **TABLE2}.get(label, {}).get(column)
