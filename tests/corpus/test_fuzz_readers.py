"""Changed bytes under every reader: what comes is a value or an error of ours, soon and in little memory.

Hypothesis draws the changes and, where one is wrong, shrinks it. HDF5 files are left out: the library itself crashes on
some damaged headers. `make stress` goes on for STRESS × 36 s, half an hour at STRESS=50. pytest's XML report (--junit-xml)
has the number of files that each reader was given.
"""

import json
import os
import shutil
import time
from pathlib import Path

import pytest
from corpus.good import write_good
from corpus.readers import READERS, changed_copy
from corpus.runner import Runner
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

STRESS = int(os.environ.get("STRESS", "1"))
SECONDS_OF_STRESS = 36.0
FEW, BATCH = 12, 10
SECONDS, MEGABYTES = 10.0, 1000.0
CHANGE = st.tuples(
    st.sampled_from(["set", "set", "flip", "insert", "delete", "cut", "number", "copy"]),
    st.floats(0, 1),
    st.booleans(),
    st.binary(min_size=1, max_size=8),
)
NUMBERS = [b"\xff" * 8, bytes(8), b"\xff" * 4, b"\x7f\xff\xff\xff", b"\0\0\0\x80"]
NUMBERS += [b"nan", b"1e400", b"-1", b"9" * 30]

SWEEP = """scans = ["*.h5"]
seeds = [0, 3]
[options]
median_filter = 3
[[grid]]
method = ["sirt", "cgls"]
iterations = [5, 20]
[[runs]]
method = "phyradgs"
control.every = 50
rates.position = [2e-4, 2e-5]
"""


def changed(data: bytes, changes: list[tuple[str, float, bool, bytes]]) -> bytes:
    """``data`` after some changes, each at a share of its length, or of its first 2 kB."""
    new = bytearray(data)
    for kind, share, early, some in changes:
        at = int(share * (min(len(new), 2048) if early else len(new)))
        if kind == "set":
            new[at : at + len(some)] = some
        elif kind == "flip" and at < len(new):
            new[at] ^= 1 << (some[0] % 8)
        elif kind == "insert":
            new[at:at] = some
        elif kind == "delete":
            del new[at : at + some[0] + 1]
        elif kind == "cut":
            del new[at:]
        elif kind == "number":
            number = NUMBERS[some[0] % len(NUMBERS)]
            new[at : at + len(number)] = number
        elif kind == "copy":
            new[at:at] = new[max(0, at - 4 * some[0]) : at]
    return bytes(new)


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    folder = write_good(tmp_path_factory.mktemp("fuzz") / "good")
    (folder / "sweep").mkdir()
    shutil.copy(folder / "fly.h5", folder / "sweep/a.h5")
    (folder / "sweep/grid.toml").write_text(SWEEP)
    lines = [json.dumps({"run": name, "options": {"a": [1, 2.5]}}) for name in ("one", "two", "three")]
    (folder / "results.jsonl").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def worker():
    runner = Runner("readers")
    yield runner
    runner.close()


def check(worker: Runner, good: Path, name: str, content: bytes) -> None:
    """AssertionError unless the reader bears ``content``."""
    path = changed_copy(READERS[name], good, good.parent / "try", content)
    answer = worker.answer([name, str(path)])
    assert answer is not None, f"{name}: the process died, or did not answer"
    said, seconds, megabytes = (answer[key] for key in ("said", "seconds", "megabytes"))
    assert said in ("value", "refused"), f"{name}: {said}"
    assert seconds < SECONDS and megabytes < MEGABYTES, f"{name}: {seconds} s, {megabytes} MB"


@pytest.mark.parametrize("name", READERS)
def test_good_files_are_read(good, worker, name) -> None:
    """What follows would prove nothing if the readers refused everything."""
    reader = READERS[name]
    path = changed_copy(reader, good, good.parent / "try", reader.content(good))
    assert worker.answer([name, str(path)])["said"] == "value"


@pytest.mark.parametrize("name", READERS)
def test_changed_bytes(good, worker, name, record_testsuite_property) -> None:
    content, before = READERS[name].content(good), worker.asked
    until_s = time.monotonic() + (STRESS * SECONDS_OF_STRESS / len(READERS) if STRESS > 1 else 0.0)
    examples = BATCH if STRESS > 1 else FEW
    phases = [Phase.explicit, Phase.generate] + ([Phase.shrink] if STRESS > 1 else [])
    quiet = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}

    @settings(max_examples=examples, derandomize=STRESS == 1, phases=phases, **quiet)
    @given(st.lists(CHANGE, min_size=1, max_size=6))
    def bears(changes: list[tuple[str, float, bool, bytes]]) -> None:
        check(worker, good, name, changed(content, changes))

    try:
        bears()
        while time.monotonic() < until_s:
            bears()
    finally:
        record_testsuite_property(f"files for {name}", worker.asked - before)
