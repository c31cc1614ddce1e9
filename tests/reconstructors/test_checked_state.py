"""States of checkpoints are believed only as far as a run can have written them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.checkpoint import (
    check_array,
    checked_history,
    count_of,
    parsed,
    restore_generator,
)

RECORD = [{"iteration": 1, "loss": 0.5}, {"iteration": 2, "loss": 0.25}]


def state(**changes: object) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(4).bit_generator.state
    arrays = {"record": json.dumps(RECORD), "seconds": 1.5, "iteration": np.int64(7), "rng": json.dumps(rng)}
    return {name: np.array(value) for name, value in (arrays | changes).items()}


def test_what_a_run_has_written_is_taken() -> None:
    assert checked_history(state()) == (RECORD, 1.5)
    assert count_of(state(), "iteration", 7) == 7
    restored = np.random.default_rng(0)
    restore_generator(restored, state())
    assert restored.random() == np.random.default_rng(4).random()


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (np.zeros(3, np.float32), r"shape \(3,\) of float32; expected shape \(2,\)"),
        (np.zeros(2), r"shape \(2,\) of float64; expected shape .* of float32"),
        (np.array([0.0, np.inf], np.float32), "NaN or infinity"),
    ],
)
def test_arrays_of_another_kind_are_named(found, words) -> None:
    with pytest.raises(InputError, match=f"checkpoint, array raw: found {words}"):
        check_array("raw", found, (2,), np.float32)


@pytest.mark.parametrize("value", [np.int64(8), np.int64(-1), np.int32(3), 3.0, "3", [np.int64(3)]])
def test_counts_out_of_reach_are_refused(value) -> None:
    with pytest.raises(InputError, match="checkpoint, array iteration"):
        count_of(state(iteration=value), "iteration", 7)


@pytest.mark.parametrize(
    ("text", "words"), [("", "not JSON"), ("[" * 50_000, "not JSON"), ("{}", "JSON dict"), ("3", "JSON int")]
)
def test_texts_of_another_kind_are_refused(text, words) -> None:
    with pytest.raises(InputError, match=f"array record: .*{words}"):
        parsed(state(record=text), "record", list)


@pytest.mark.parametrize("line", [3, "x", {"iteration": "one"}, {"iteration": [1]}, None])
def test_lines_that_are_no_tables_of_numbers_are_refused(line) -> None:
    with pytest.raises(InputError, match="array record: found a line that is no table"):
        checked_history(state(record=json.dumps([*RECORD, line])))


@pytest.mark.parametrize(
    "content",
    [{}, {"bit_generator": "MT19937"}, {"bit_generator": "PCG64", "state": {"state": -1, "inc": 1}}],
)
def test_generators_of_another_kind_are_refused(content) -> None:
    with pytest.raises(InputError, match="array rng: found no state of a random generator"):
        restore_generator(np.random.default_rng(0), state(rng=json.dumps(content)))


def test_what_is_missing_is_named() -> None:
    arrays = state()
    del arrays["seconds"]
    with pytest.raises(InputError, match="seconds"):
        checked_history(arrays)
