"""Frames to line integrals, and arrays out of pickles: what is refused, and what it says."""

import io

import numpy as np
import pytest
from tolerances import FLOAT32

from phyradgs_cl.acquisition import Saturation
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions
from phyradgs_cl.importers.formats.pickles import PlainUnpickler
from phyradgs_cl.importers.frames import line_integrals

pytestmark = pytest.mark.slow
FRAMES = np.array([[[100.0, 50.0], [25.0, 10.0]]] * 3, np.float32)


def test_flats_one_value_none_or_of_another_panel() -> None:
    found = line_integrals("f", FRAMES, ImportOptions(flat_value=100.0))
    np.testing.assert_allclose(found.values, -np.log(FRAMES / 100), rtol=0, atol=FLOAT32)
    assert found.mask is None and found.saturation == Saturation(100.0, 0.0)
    with pytest.raises(InputError, match="quantity: found nothing that says it.*say quantity"):
        line_integrals("f", FRAMES, ImportOptions())
    with pytest.raises(InputError, match="f flats: found none.*say flat_value"):
        line_integrals("f", FRAMES, ImportOptions(quantity="counts"))
    for name in ("flats", "darks"):
        stacks = {"flats": np.full((1, 2, 2), 100.0, np.float32), name: np.ones((1, 3, 2), np.float32)}
        with pytest.raises(InputError, match=r"flats or darks of \(3, 2\)"):
            line_integrals("f", FRAMES, ImportOptions(), **stacks)


def test_values_that_no_object_has_are_masked_in_one_line(caplog, recwarn) -> None:
    frames = np.full((2, 2, 2), 0.5)
    frames[1, 0] = [1e300, np.nan]
    found = line_integrals("f", frames, ImportOptions(quantity="attenuation"))
    np.testing.assert_array_equal(found.mask, ~(frames < 1))
    assert found.values.max() == 0.5 and caplog.messages == ["f: 2 line integrals are not finite or beyond 1e+06: masked"]
    with pytest.raises(InputError, match="no usable value"):
        line_integrals("f", frames, ImportOptions(), flats=np.full((3, 2, 2), 1e308))
    assert not recwarn


def test_clipped_counts_are_masked_in_their_own_frames(caplog) -> None:
    noise = np.random.default_rng(0).normal(0, 60, (3, 40, 40))
    frames = np.minimum(30000 + 500 * np.arange(40) + noise, 40000).round().astype(np.uint16)
    frames[2] -= 11000  # this one is dark enough
    darks = np.zeros((1, 40, 40))
    found = line_integrals("f", frames, ImportOptions(flat_value=50000.0), darks=darks)
    np.testing.assert_array_equal(found.mask, frames == 40000)
    share = np.mean(frames == 40000)
    assert found.saturation == Saturation(40000.0, share) and not found.mask[2].any()
    same = line_integrals("f", frames, ImportOptions(flat_value=40000.0), darks=darks)
    assert same.mask is None and same.saturation == found.saturation and (same.values[frames == 40000] == 0).all()
    text = f"f: {100 * share:.3g} % of the projections' pixels are clipped at 40000 counts: "
    assert caplog.messages == [text + "masked, each in its own frame", text + "taken as air, for flat_value is no brighter"]
    line_integrals("f", frames, ImportOptions(), flats=np.full((2, 40, 40), 40000.0), darks=darks)
    assert caplog.messages[-1] == text + "taken as air, for the flats are clipped too"


RAW = np.arange(6, dtype="<i2").tobytes()
CALLS = {
    "numpy.core.numeric _frombuffer": [
        ((RAW, "TYPE", (7,), "C"), r"shape \(7,\) in 12 bytes"), ((RAW, "i2", (6,), "C"), "without numbers"),
        *(((RAW, "TYPE", shape, "C"), "impossible shape") for shape in ((-6,), (1,) * 9, [6], (True,))),
    ],
    "numpy dtype": [((code,), "plain real numbers") for code in ("O8", "c8", "V9", "i4,i4", "a", "b1\n", 3)],
    "numpy ndarray": [(((3,),), "no arguments")], "numpy load": [(("x",), "a call of numpy.load")],
}


def test_what_is_no_array_of_plain_numbers_is_refused() -> None:
    """NumPy's own constructors would read memory where a type of objects, or one with fields, points."""
    machine = PlainUnpickler(io.BytesIO(b""))
    for name, cases in CALLS.items():
        for arguments, words in cases:
            dtype = machine.find_class("numpy", "dtype")("i2")
            given = [dtype if a == "TYPE" else a for a in arguments]
            with pytest.raises((InputError, ValueError, TypeError), match=words):
                machine.find_class(*name.split())(*given)
    with pytest.raises(ValueError):
        machine.find_class("numpy", "dtype")("i2").__setstate__((3, {"names": 1}, None, ("a",), {}))


def test_a_pickle_cannot_change_a_function_of_this_process() -> None:
    """The opcode BUILD sets attributes of whatever find_class has returned: that is made for one name of one pickle."""
    machine = PlainUnpickler(io.BytesIO(b""))
    names = [("numpy", "dtype"), ("numpy.core.multiarray", "_reconstruct"), ("numpy.core.numeric", "_frombuffer")]
    assert all(machine.find_class(*name) is not machine.find_class(*name) for name in names)
