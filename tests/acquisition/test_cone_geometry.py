"""Where source, detector and pixels stand, against formulas written out element by element."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, pixel_centres, transpose_pose
from phyradgs_cl.acquisition.geometry import plain_geometry
from phyradgs_cl.errors import InputError

TOLERANCE_MM = 1e-10  # rounding of float64 at 1200 mm
GEOMETRY = ConeGeometry(785.0, 1200.0, (7, 10), (0.6, 0.5), (1.25, -2.5))
ANGLES_RAD = [0.0, 0.3, math.pi / 2, 2.0, -1.1, 7.0]


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_source_and_pixel_centres_by_hand(angle_rad) -> None:
    pose, cos, sin = GEOMETRY.pose(angle_rad), math.cos(angle_rad), math.sin(angle_rad)
    np.testing.assert_allclose(pose[:3], [785 * cos, 785 * sin, 0], atol=TOLERANCE_MM)
    centres = pixel_centres(pose, GEOMETRY.detector_shape)
    assert centres.shape == (7, 10, 3)
    for row, column in [(0, 0), (6, 9), (2, 7)]:
        along_u_mm, along_v_mm = -2.5 + (column - 4.5) * 0.5, 1.25 + (row - 3.0) * 0.6
        expected = [-415 * cos - along_u_mm * sin, -415 * sin + along_u_mm * cos, along_v_mm]
        np.testing.assert_allclose(centres[row, column], expected, atol=TOLERANCE_MM)


def test_the_nearest_circle_of_a_circle_is_itself() -> None:
    poses = GEOMETRY.pose(np.array(ANGLES_RAD))
    for height_mm in (0.0, 40.0):
        poses[:, [2, 5]] += height_mm
        found = plain_geometry(poses, GEOMETRY.detector_shape)
        for name, expected in asdict(GEOMETRY).items():
            np.testing.assert_allclose(getattr(found, name), expected, atol=TOLERANCE_MM, err_msg=name)


def test_middle_pixels_and_many_angles_at_once() -> None:
    geometry = ConeGeometry(5.0, 7.0, (5, 5), (0.1, 0.2))
    pose = geometry.pose(0.4)
    middle = pixel_centres(pose, (5, 5))[2, 2]
    np.testing.assert_allclose(middle, pose[:3] * (1 - 7 / 5), atol=TOLERANCE_MM)
    angles = np.array(ANGLES_RAD).reshape(2, 3)
    poses = GEOMETRY.pose(angles)
    assert poses.shape == (2, 3, 12)
    np.testing.assert_array_equal(poses[1, 2], GEOMETRY.pose(7.0))
    assert pixel_centres(poses, (7, 10)).shape == (2, 3, 7, 10, 3)


def test_scaled_and_transposed_poses() -> None:
    np.testing.assert_allclose(GEOMETRY.scaled(0.01).pose(0.7), 0.01 * GEOMETRY.pose(0.7), atol=1e-14)
    assert GEOMETRY.scaled(0.01).magnification == pytest.approx(1200 / 785)
    pose = GEOMETRY.pose(0.7)
    turned = pixel_centres(transpose_pose(pose), (10, 7))
    np.testing.assert_allclose(turned, pixel_centres(pose, (7, 10)).swapaxes(0, 1), atol=TOLERANCE_MM)
    np.testing.assert_array_equal(transpose_pose(transpose_pose(pose)), pose)


def test_lists_and_arrays_make_the_same_geometry() -> None:
    shape, pixels, offsets = ([*pair] for pair in ((7, 10), (0.6, 0.5), (1.25, -2.5)))
    for kind in (list, np.array):
        same = ConeGeometry(785.0, 1200.0, kind(shape), kind(pixels), kind(offsets))
        assert same == GEOMETRY and hash(same) == hash(GEOMETRY)
    for side in (0.5, np.float32(0.5), 1):  # one number is a square pixel
        square = ConeGeometry(785.0, 1200.0, (7, 10), side)
        assert square == ConeGeometry(785.0, 1200.0, (7, 10), (side, side)) and square.pixel_size_mm == (side, side)


def test_nonsense_is_refused_by_name() -> None:
    small = ConeGeometry(0.25, 0.5, (4, 4), (0.01, 0.01))  # machines may be smaller than a millimetre
    assert (small.source_to_axis_mm, small.magnification) == (0.25, 2.0)
    for name, value in [
        ("source_to_axis_mm", 0.0), ("source_to_axis_mm", math.nan), ("source_to_detector_mm", 0.0),
        ("source_to_detector_mm", -1.0), ("detector_shape", (0, 5)), ("pixel_size_mm", (0.5, 0.0)),
        ("pixel_size_mm", (0.5,)), ("pixel_size_mm", 0.0), ("detector_offset_mm", (math.inf, 0.0)),
    ]:  # fmt: skip
        with pytest.raises(InputError, match=name):
            replace(small, **{name: value})
