"""Errors say everything on one line; checks raise exactly where they should."""

import pickle

import numpy as np
import pytest

from phyradgs_cl import checks, errors
from phyradgs_cl.errors import InputError, NumericalError, PhyradgsError


def test_message_names_subject_found_expected_and_remedy_on_one_line() -> None:
    error = InputError("scan.h5:/entry/data", "shape\n(3, 4)", "three axes", "store (F, v, u)")
    assert str(error) == "scan.h5:/entry/data: found shape (3, 4); expected three axes; store (F, v, u)"
    for arguments, text in (
        (("dose",), "dose"),
        (("dose", "", "a number"), "dose: expected a number"),
        (("dose", "", "", "give one"), "dose: give one"),
        (("--dose", "given with --noise none"), "--dose: given with --noise none"),  # a state, which is not found
    ):
        assert str(PhyradgsError(*arguments)) == text  # missing parts leave no trace


def test_every_error_is_a_phyradgs_error_with_its_exit_code() -> None:
    names = {"Input": 2, "NoSuchDevice": 2, "Numerical": 3, "Output": 4, "Device": 5, "OutOfMemory": 6}
    for name, code in names.items():
        kind = getattr(errors, f"{name}Error")
        assert issubclass(kind, PhyradgsError) and kind.exit_code == code, name


def test_in_python_errors_name_arguments_for_options() -> None:
    """But in commands and values, which are in quotes."""
    for text, told in (
        ("--time-error", "time_error"),
        ("--with: readout axis", "others: readout axis"),
        ("the scan's --size or one's --roi-mm", "the scan's size or one's roi_mm"),
        ("'--no-option', see 'phyradgs check --fix-offset'", "'--no-option', see 'phyradgs check --fix-offset'"),
        ("1--2", "1--2"),
    ):
        with pytest.raises(NumericalError) as raised, errors.naming_arguments():
            raise NumericalError(text, text, text, text)
        assert str(raised.value) == f"{told}: found {told}; expected {told}; {told}"
        assert pickle.loads(pickle.dumps(raised.value)).remedy == told


def test_numbers_choices_and_arrays_are_checked() -> None:
    for value in (0, -1, 0.0, float("nan"), float("inf"), "3", None, True, np.float32(-2)):
        with pytest.raises(InputError, match=r"^size: found .*above 0$"):
            checks.positive("size", value)  # type: ignore[arg-type]
    for value in (1, 1e-300, np.float32(2), np.int64(5)):
        checks.positive("size", value)
    checks.at_least("count", 3, 3)
    checks.finite("p", [[1, 2], [3, 4]])
    for check, told in (
        (lambda: checks.at_least("count", 2.99, 3), "count: found 2.99; expected a finite number, at least 3"),
        (lambda: checks.one_of("model", "lgo", ("log", "intensity")), "found 'lgo'; expected one of 'log', 'intensity'"),
        (lambda: checks.finite("p", [[1.0, np.nan], [np.inf, 0.0]]), r"p: found 2 NaN or infinite .*first at \(0, 1\)"),
    ):
        with pytest.raises(InputError, match=told):
            check()
