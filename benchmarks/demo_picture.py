"""One picture of several reconstructions beside the truth.

    python benchmarks/demo_picture.py OUT.png SCAN.h5 LABEL=VOLUME.h5 ...

Two orthogonal slices through the middle, all at the truth's grey scale, PSNR in the titles.
"""

import sys
from pathlib import Path

from matplotlib.figure import Figure

from phyradgs_cl.io import read_volume
from phyradgs_cl.metrics import psnr
from phyradgs_cl.workflow import load_reference


def main(arguments: list[str]) -> None:
    picture, scan, *pairs = arguments
    truth, _ = load_reference(Path(scan))
    volumes = {label: read_volume(path).volume for label, path in (pair.split("=", 1) for pair in pairs)}
    titles = [f"{label}\n{psnr(volume, truth):.1f} dB" for label, volume in volumes.items()] + ["truth\n"]
    middle = truth.shape[2] // 2, truth.shape[1] // 2
    figure = Figure(figsize=(2.6 * len(titles), 5.6), layout="constrained")
    axes = figure.subplots(2, len(titles))
    for column, (title, volume) in enumerate(zip(titles, [*volumes.values(), truth], strict=True)):
        for row, section in enumerate((volume[:, :, middle[0]], volume[:, middle[1], :])):
            axes[row, column].imshow(section, cmap="gray", origin="lower", vmin=0, vmax=truth.max())
            axes[row, column].set_axis_off()
        axes[0, column].set_title(title)
    figure.savefig(picture, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main(sys.argv[1:])
