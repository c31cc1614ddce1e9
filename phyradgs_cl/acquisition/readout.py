"""Lines first: operators see a frame with the readout's lines as its rows, whatever they are on the detector."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition.geometry import transpose_pose


@dataclass(frozen=True)
class Readout:
    """``axis``: what a line is, "rows" or "columns" of the detector."""

    axis: str

    def shape(self, detector_shape: tuple[int, int]) -> tuple[int, int]:
        """(lines, width) of a (rows, columns) detector."""
        rows, columns = detector_shape
        return (rows, columns) if self.axis == "rows" else (columns, rows)

    def frames(self, frames: np.ndarray) -> np.ndarray:
        """Frames (..., rows, columns) as (..., lines, width), or back: a view."""
        return frames if self.axis == "rows" else frames.swapaxes(-1, -2)

    def poses(self, pose: np.ndarray) -> np.ndarray:
        """Poses (..., 12) of frames with lines first, or back."""
        return pose if self.axis == "rows" else transpose_pose(pose)

    def spread(self, by_line: np.ndarray) -> np.ndarray:
        """Values (..., lines) that broadcast with frames (..., rows, columns)."""
        return by_line[..., :, None] if self.axis == "rows" else by_line[..., None, :]
