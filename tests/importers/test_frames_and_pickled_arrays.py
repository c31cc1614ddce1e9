"""Frames to line integrals, masks put together, and arrays out of pickles: what is refused, and what it says."""

from __future__ import annotations

import numpy as np
import pytest
from tolerances import FLOAT32

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions
from phyradgs_cl.importers.frames import compact, line_integrals, united, upright
from phyradgs_cl.importers.pickle_arrays import CALLS, DtypeOnItsWay, array_view

FRAMES = np.array([[[100.0, 50.0], [25.0, 10.0]]] * 3, np.float32)


def test_one_flat_value_stands_for_flat_frames() -> None:
    integrals, mask = line_integrals("f", FRAMES, ImportOptions(flat_value=100.0))
    np.testing.assert_allclose(integrals, -np.log(FRAMES / 100), rtol=0, atol=FLOAT32)
    assert mask is None


def test_counts_without_flats_say_what_to_do() -> None:
    with pytest.raises(InputError, match="quantity: found nothing that says it.*--quantity"):
        line_integrals("f", FRAMES, ImportOptions())
    with pytest.raises(InputError, match="f flats: found none.*--flat-value"):
        line_integrals("f", FRAMES, ImportOptions(quantity="counts"))


@pytest.mark.parametrize("name", ["flats", "darks"])
def test_flats_and_darks_of_another_panel_are_refused(name) -> None:
    stacks = {"flats": np.full((1, 2, 2), 100.0, np.float32), name: np.ones((1, 3, 2), np.float32)}
    with pytest.raises(InputError, match=r"flats or darks of \(3, 2\)"):
        line_integrals("f", FRAMES, ImportOptions(), **stacks)


def test_masks() -> None:
    one, other = np.array([[True, False]]), np.array([[False, False]])
    assert united(None, None) is None
    assert united(one, None) is one and united(None, one) is one
    np.testing.assert_array_equal(united(one, ~one), True)
    assert compact(np.stack([other, other])) is None
    np.testing.assert_array_equal(compact(np.stack([one, one])), one)
    assert compact(np.stack([one, other])).shape == (2, 1, 2)
    with pytest.raises(InputError, match="no usable value"):
        compact(np.stack([one | True, one | True]))


def test_frames_are_turned_upright() -> None:
    frames = np.arange(4).reshape(1, 2, 2)
    np.testing.assert_array_equal(upright(frames, ImportOptions(), "bottom"), frames)
    np.testing.assert_array_equal(upright(frames, ImportOptions(), "top"), frames[:, ::-1])
    np.testing.assert_array_equal(upright(frames, ImportOptions(row_0="bottom"), "top"), frames)
    np.testing.assert_array_equal(upright(frames, ImportOptions(), "bottom", "right"), frames[..., ::-1])


RAW = np.arange(6, dtype="<i2").tobytes()
TYPE = DtypeOnItsWay("i2", "<")


def test_arrays_are_views_of_the_files_bytes() -> None:
    np.testing.assert_array_equal(array_view(RAW, TYPE, (2, 3), "C"), np.arange(6).reshape(2, 3))
    np.testing.assert_array_equal(
        array_view(RAW.decode("latin1"), TYPE, (2, 3), "F"), np.arange(6).reshape(3, 2).T
    )
    assert CALLS["scalar"](DtypeOnItsWay("f8", "<"), np.float64(2.5).tobytes()) == 2.5
    np.testing.assert_array_equal(CALLS["frombuffer"](RAW, TYPE, (6,), "C"), np.arange(6))
    assert CALLS["encode"]("é", "latin1") == b"\xe9" and CALLS["bytearray"](b"ab") == b"ab"
    assert CALLS["dtype"]("f4", False, True) == DtypeOnItsWay("f4")


@pytest.mark.parametrize(
    ("name", "arguments", "words"),
    [
        ("frombuffer", (RAW, TYPE, (7,), "C"), r"shape \(7,\) in 12 bytes"),
        ("frombuffer", (RAW, TYPE, (-6,), "C"), "impossible shape"),
        ("frombuffer", (RAW, TYPE, (1 << 41,), "C"), "impossible shape"),
        ("frombuffer", (RAW, TYPE, (1,) * 9, "C"), "impossible shape"),
        ("frombuffer", (RAW, TYPE, [6], "C"), "impossible shape"),
        ("frombuffer", (RAW, TYPE, (True,), "C"), "impossible shape"),
        ("frombuffer", (RAW, "i2", (6,), "C"), "without numbers"),
        ("frombuffer", (None, TYPE, (6,), "C"), "without numbers"),
        ("frombuffer", (RAW, DtypeOnItsWay("O8"), (6,), "C"), "plain real numbers"),
        ("frombuffer", (RAW, DtypeOnItsWay("c8"), (6,), "C"), "plain real numbers"),
        ("encode", ("a", "utf-7"), "not latin1"),
        ("encode", (b"a", "latin1"), "not latin1"),
        ("dtype", ("i4,i4,i4",), "plain real numbers|no plain number"),
        ("dtype", ("a" * 9,), "no plain number"),
        ("dtype", (3,), "no plain number"),
        ("bytearray", ("text",), "not made of bytes"),
        ("ndarray", ((3,),), "a call of numpy.ndarray"),
    ],
)
def test_what_is_no_array_of_plain_numbers_is_refused(name, arguments, words) -> None:
    with pytest.raises((ValueError, TypeError), match=words):
        found = CALLS[name](*arguments)
        found.finished()
