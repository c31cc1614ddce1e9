"""Errors say everything on one line; checks raise exactly where they should."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from phyradgs_cl import checks
from phyradgs_cl.errors import (
    DeviceError,
    InputError,
    NoSuchDeviceError,
    NumericalError,
    OutOfMemoryError,
    OutputError,
    PhyradgsError,
)


def test_message_names_culprit_found_expected_and_remedy_on_one_line() -> None:
    error = InputError("scan.h5:/entry/data", "shape\n(3, 4)", "three axes", "store (F, v, u)")
    assert str(error) == "scan.h5:/entry/data: found shape (3, 4); expected three axes; store (F, v, u)"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("dose",), "dose"),
        (("dose", "-1"), "dose: found -1"),
        (("dose", "", "a number"), "dose: expected a number"),
        (("dose", "", "", "give one"), "dose: give one"),
    ],
)
def test_missing_parts_leave_no_trace(arguments: tuple[str, ...], text: str) -> None:
    assert str(PhyradgsError(*arguments)) == text


@pytest.mark.parametrize(
    "kind", [InputError, OutputError, DeviceError, NumericalError, OutOfMemoryError, NoSuchDeviceError]
)
def test_every_error_is_a_phyradgs_error_with_its_exit_code(kind: type[PhyradgsError]) -> None:
    assert issubclass(kind, PhyradgsError)
    codes = {
        InputError: 2,
        NumericalError: 3,
        OutputError: 4,
        DeviceError: 5,
        OutOfMemoryError: 6,
        NoSuchDeviceError: 2,
    }
    assert kind.exit_code == codes[kind]


def test_errors_survive_pickling_as_worker_processes_need() -> None:
    error = NumericalError("density", "NaN", "finite", "lower the learning rate")
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy), copy.remedy) == (NumericalError, str(error), error.remedy)


@pytest.mark.parametrize("value", [0, -1, 0.0, float("nan"), float("inf"), "3", None, True, np.float32(-2)])
def test_positive_rejects(value: object) -> None:
    with pytest.raises(InputError, match=r"^size: found .*above 0$"):
        checks.positive("size", value)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [1, 1e-300, np.float32(2), np.int64(5)])
def test_positive_accepts(value: float) -> None:
    checks.positive("size", value)


def test_at_least_includes_its_minimum() -> None:
    checks.at_least("count", 3, 3)
    with pytest.raises(InputError, match=r"count: found 2.99; expected a finite number, at least 3"):
        checks.at_least("count", 2.99, 3)


def test_one_of_lists_the_choices() -> None:
    checks.one_of("model", "log", ("log", "intensity"))
    with pytest.raises(InputError, match="found 'lgo'; expected one of 'log', 'intensity'"):
        checks.one_of("model", "lgo", ("log", "intensity"))


def test_finite_counts_and_locates() -> None:
    checks.finite("p", [[1, 2], [3, 4]])
    with pytest.raises(InputError, match=r"p: found 2 NaN or infinite values, first at \(0, 1\)"):
        checks.finite("p", [[1.0, np.nan], [np.inf, 0.0]])


def test_shape_allows_any_length_where_none() -> None:
    checks.shape("data", np.zeros((4, 5)), (None, 5))
    for array in (np.zeros((4, 6)), np.zeros(5), np.zeros((4, 5, 1))):
        with pytest.raises(InputError, match=r"expected shape \(any, 5\)"):
            checks.shape("data", array, (None, 5))
