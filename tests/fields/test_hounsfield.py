"""Hounsfield units: two points from boxes or from a volume's peaks, what is refused, and the note in a file."""

import numpy as np
import pytest
from refusals import assert_refused

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, Hounsfield
from phyradgs_cl.fields.hounsfield import fitted, of_facts, of_note
from phyradgs_cl.io import Volume

GRID = Grid((24, 32, 40), (2.0, 1.5, 1.0), (7.0, -3.0, 30.0))
AIR, WATER, INSERT = 0.0012, 0.0206, 0.0412  # of a scan with some scatter; the insert has about 1000 HU


def phantom(noise: float = 0.0, metal: float = 0.0) -> np.ndarray:
    """(z, y, x) float32 in 1/mm: water in air, a dense insert, and metal in two voxels of a thousand."""
    values = np.full(GRID.shape, AIR)
    values[4:20, 4:28, 4:36] = WATER
    values[6:18, 8:14, 8:14] = INSERT
    values[10:14, 20:24, 26:30] += metal
    return (values + noise * np.random.default_rng(3).normal(size=values.shape)).astype(np.float32)


def box(z: slice, y: slice, x: slice) -> tuple[float, ...]:
    """The box in mm around the centres of some voxels."""
    axes = zip(GRID.axes_mm(), (z, y, x), GRID.voxel_size_mm, strict=True)
    return tuple(end for axis, part, side in axes for end in (axis[part][0] - side / 2, axis[part][-1] + side / 2))


AIR_BOX, WATER_BOX = box(slice(0, 3), slice(0, 9), slice(0, 9)), box(slice(6, 18), slice(15, 19), slice(8, 24))
INSERT_BOX = box(slice(7, 17), slice(9, 13), slice(9, 13))


@pytest.mark.parametrize("noise", [0.0, 0.0004, 0.002])
@pytest.mark.parametrize("metal", [0.0, 0.5, 2.0])
def test_both_ways_find_air_and_water(noise, metal) -> None:
    values = phantom(noise, metal)
    for boxes in ((None, None), (AIR_BOX, None), (None, WATER_BOX), (AIR_BOX, WATER_BOX)):
        scale = fitted(values, GRID, *boxes)
        assert (scale.air_per_mm, scale.water_per_mm) == pytest.approx((AIR, WATER), abs=1e-6 + 0.15 * noise), boxes
        assert scale.line.count("voxels of") == 2 and scale.line.count("peak") == boxes.count(None)
    assert np.median(fitted(values, GRID).of(values)[0]) == pytest.approx(-1000, abs=1 + 1e5 * noise)


def test_an_insert_of_known_hu_gives_water() -> None:
    hu = 1000 * (INSERT - WATER) / (WATER - AIR)
    scale = fitted(phantom(), GRID, AIR_BOX, INSERT_BOX, hu)
    assert (scale.air_per_mm, scale.water_per_mm) == pytest.approx((AIR, WATER), rel=1e-5)
    assert f"insert of {hu:g} HU" in scale.line and "so water 0.0206" in scale.line


def test_what_is_no_scale_is_refused() -> None:
    values = phantom(0.0004)
    no_air, small = np.maximum(values, 0.015), box(slice(6, 8), slice(15, 19), slice(8, 20))
    assert_refused({
        "water: found 96 voxels.*at least 100": lambda: fitted(values, GRID, AIR_BOX, small),
        "air: found 0 voxels": lambda: fitted(values, GRID, tuple(1000 + end for end in AIR_BOX), WATER_BOX),
        "expected air below water": lambda: fitted(values, GRID, WATER_BOX, AIR_BOX),
        "air near 0; state a box": lambda: fitted(no_air, GRID),
        "[01] peaks? in the volume": lambda: fitted(values[:, :, :4], Grid((24, 32, 4), (1.0, 1.0, 1.0))),
        "as of Hounsfield units": lambda: Volume(Hounsfield(WATER).of(values), GRID).hounsfield(),
        "shape \\(6\\)": lambda: fitted(values, GRID, (1.0, 2.0, 3.0)),
        "Z0 below Z1": lambda: fitted(values, GRID, AIR_BOX[::-1], WATER_BOX),
        "--insert-hu": lambda: fitted(values, GRID, AIR_BOX, WATER_BOX, -1000),
        "air of 0.02, not below water": lambda: Hounsfield(0.02, 0.02),
        "0 peaks": lambda: fitted(np.full(GRID.shape, 0.02, np.float32), GRID),
    })  # fmt: skip


def test_a_scale_comes_back_from_its_note_and_facts_and_its_values_once() -> None:
    scale, values = Hounsfield(WATER, AIR, "said"), phantom(0.001)
    again = of_note(f"\0\0{scale.note}\0padding")
    assert again == (True, Hounsfield(WATER, AIR)) and of_facts(scale.facts()) == scale
    np.testing.assert_allclose(scale.per_mm(scale.of(values)), values, atol=1e-8)
    assert (of_note("values in 1/mm"), of_note("values in HU")) == ((False, None), (True, None))
    assert len(scale.note) < 80  # NIfTI's field
    with pytest.raises(InputError, match="a table of water_per_mm"):
        of_facts({"hounsfield": {"water": 1}})


def test_other_units_of_length_and_a_box_of_two_materials_are_warned_of(caplog) -> None:
    fitted(10 * phantom(), GRID)
    fitted(phantom(0.002), GRID, AIR_BOX, WATER_BOX)
    assert not caplog.records
    fitted(100 * phantom(), GRID)
    assert "check that lengths are in mm" in caplog.text
    fitted(phantom(0.002), GRID, AIR_BOX, box(slice(0, 8), slice(15, 19), slice(8, 24)))  # half of it in air
    assert "--water-mm: found water" in caplog.text and "one material" in caplog.text
