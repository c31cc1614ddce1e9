"""Poses that no circle describes: tables of them over time, row 0 the lowest, with a plain geometry to go by."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import PoseTable
from phyradgs_cl.acquisition.trajectory import resting_poses
from phyradgs_cl.importers.timing import Timing

_SLACK = 1e-6  # of a span: how far a table runs beyond the times that are asked for


@dataclass(frozen=True)
class Turned:
    """How stored images have to be flipped so that v̂ points up and û to the right, seen from the source."""

    rows: bool
    columns: bool

    def frames(self, array: np.ndarray) -> np.ndarray:
        """Frames or masks (..., v, u), flipped."""
        array = array[..., ::-1, :] if self.rows else array
        return array[..., ::-1] if self.columns else array

    def poses(self, pose: np.ndarray, panel: tuple[int, int]) -> np.ndarray:
        """Poses (..., 12) of the flipped images."""
        pose = np.array(pose, np.float64)
        if self.rows:
            pose[..., 3:6] += (panel[0] - 1) * pose[..., 9:12]
            pose[..., 9:12] *= -1
        if self.columns:
            pose[..., 3:6] += (panel[1] - 1) * pose[..., 6:9]
            pose[..., 6:9] *= -1
        return pose


def turn_of(pose: np.ndarray) -> Turned:
    """How a stored image is flipped to row 0 below and column 0 left, from one of its poses (12,)."""
    source, step_u, step_v = pose[:3], pose[6:9], pose[9:12]
    right = np.array([-source[1], source[0], 0.0])
    return Turned(rows=bool(step_v[2] < 0), columns=bool(step_u @ right < 0))


def table_over_time(pose_at: Callable[[np.ndarray], np.ndarray], timing: Timing, subject: str) -> PoseTable:
    """A pose table that covers every frame's window. ``pose_at``: poses (T, 12) at frame positions (T,), where 2.5 is
    halfway from frame 2 to 3; a gantry at rest has each frame's pose at its middle."""
    if not timing.is_fly:
        at_s = np.asarray(timing.start_s) + timing.shutter.middle_s
        poses = pose_at(np.arange(len(at_s), dtype=np.float64))
        return resting_poses(poses, at_s, timing.shutter.span_s, f"{subject} poses")
    at_s = timing.angle_time_s
    span_s = timing.shutter.span_s
    before, after = at_s[0] - timing.start_s[0] + _SLACK * span_s, timing.start_s[-1] + span_s - at_s[-1]
    first = at_s[0] - max(before, 0.0)
    last = at_s[-1] + max(after, 0.0) + _SLACK * span_s
    time_s = np.concatenate([[first], at_s, [last]])
    position = np.concatenate([
        [-(at_s[0] - first) / (at_s[1] - at_s[0])],
        np.arange(len(at_s)),
        [len(at_s) - 1 + (last - at_s[-1]) / (at_s[-1] - at_s[-2])],
    ])  # fmt: skip
    return PoseTable(time_s, pose_at(position), f"{subject} poses")
