"""Plain arrays in mm to the splats' internal rows and padded images, and back, against NumPy in every build."""

import numpy as np
import pytest
from tolerances import FLOAT32

from phyradgs_cl.operators.splats.layout import pad_columns
from phyradgs_cl.operators.splats.operator import QUATERNION_LENGTHS, PlainImages, PlainRows
from phyradgs_cl.runtime.layout import pad_rows, unpad_rows

LENGTH_MM = 12.5


@pytest.mark.parametrize("line_integrals", [True, False])
def test_rows_there_and_gradients_back(any_rt, make_cloud, line_integrals) -> None:
    rows = make_cloud(21, spread=LENGTH_MM).astype(np.float32)
    units = np.ones((11, 21))
    units[:6], units[10] = 1 / LENGTH_MM, LENGTH_MM if line_integrals else 1.0
    units[6:10] = 1 / np.geomspace(*QUATERNION_LENGTHS, 21)  # one over the quaternions' norms
    given = rows.copy()
    given[6:10] /= units[6:10]
    plain = PlainRows(any_rt, LENGTH_MM, line_integrals=line_integrals)
    point = plain.enter(any_rt.upload(given))
    found = any_rt.download(point.gaussians.rows)
    assert np.allclose(found, pad_columns(given * units), rtol=FLOAT32, atol=FLOAT32)
    gradients = np.random.default_rng(1).normal(size=(13, point.gaussians.stride)).astype(np.float32)
    total = any_rt.upload(np.zeros((11, 21), np.float32))
    for add in (False, True):
        plain.leave(any_rt.upload(gradients), point, total, add=add)
    assert np.allclose(any_rt.download(total), 2 * units * gradients[:11, :21], rtol=FLOAT32)


@pytest.mark.parametrize("turned", [False, True])
def test_images_there_and_back(two_rt, turned) -> None:
    images = np.random.default_rng(0).normal(size=(3, 5, 37)).astype(np.float32)
    by_line = images.swapaxes(1, 2) if turned else images
    lines, width = by_line.shape[1:]
    plain = PlainImages(two_rt, lines, width, turned=turned)
    there, back = two_rt.upload(images), two_rt.zeros(images.shape)
    for number in (2, 0, 1):
        image = plain.enter(there, number)
        assert np.array_equal(two_rt.download(image), pad_rows(by_line[number]))
        assert np.array_equal(unpad_rows(two_rt.download(image), (lines, width)), by_line[number])
        plain.leave(image, back, number)
    assert np.array_equal(two_rt.download(back), images)
