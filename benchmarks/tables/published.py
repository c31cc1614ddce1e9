"""The paper's own numbers, printed beside ours as a reference. Their data, volumes and hardware differ.

They are from PhyRadGS, Tables 1 and 2: PSNR in dB and SSIM of the columns "rapid", "standard" and "phantom"."""

from typing import NamedTuple


class Published(NamedTuple):
    """One cell of the paper's tables."""

    psnr_db: float
    ssim: float


Columns = dict[str, Published]


def _columns(rapid: tuple[float, float], *others: tuple[float, float]) -> Columns:
    return {name: Published(*cell) for name, cell in zip(("rapid", "standard", "phantom"), (rapid, *others), strict=False)}


TABLE1: dict[str, Columns] = {
    "FDK": _columns((18.01, 0.090), (20.72, 0.152), (30.04, 0.794)),
    "ASD-POCS": _columns((27.99, 0.777), (30.94, 0.834), (30.29, 0.844)),
    "NAF": _columns((28.18, 0.776), (30.96, 0.844), (27.52, 0.779)),
    "SAX-NeRF": _columns((28.02, 0.773), (30.62, 0.849)),
    "R2-Gaussian": _columns((28.93, 0.828), (32.12, 0.889), (35.12, 0.852)),
    "PhyRadGS w/o ST": _columns((29.00, 0.834), (31.96, 0.891), (35.13, 0.855)),
    "R2-Gaussian w/ ST": _columns((31.22, 0.866), (33.97, 0.909), (36.84, 0.861)),
    "PhyRadGS": _columns((31.23, 0.871), (33.54, 0.910), (37.43, 0.862)),
}
TABLE2: dict[str, Columns] = {
    "M=1 N=5": _columns((29.79, 0.851)),
    "M=4 N=5": _columns((30.62, 0.869)),
    "M=8 N=5": _columns((31.22, 0.871)),
    "M=16 N=5": _columns((31.53, 0.884)),
    "M=8 N=1": _columns((29.27, 0.848)),
    "M=8 N=3": _columns((31.16, 0.870)),
    "M=8 N=7": _columns((31.21, 0.873)),
}


def published(label: str, column: str) -> Published | None:
    """Returns the paper's cell of a row in the column "rapid", "standard" or "phantom"; None where it has none."""
    return {**TABLE1, **TABLE2}.get(label, {}).get(column)
