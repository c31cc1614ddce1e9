"""Every damaged or hostile file of the corpus through the real command: its own verdict, one line, in bounds."""

import os
import random
import shutil
from collections import defaultdict
from pathlib import Path

import pytest
from corpus.case import Case
from corpus.everything import all_cases
from corpus.good import write_good
from corpus.runner import Outcome, Runner

SEED = 0
SECONDS, MEGABYTES = 10.0, 1000.0
# STRESS is what `make stress` sets: there all of them, here some of every kind
STRESSED = int(os.environ.get("STRESS", "1")) > 1
LEAST, SOME = 1500, 220
pytestmark = pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(), reason="memory's peak as POSIX' Linux counts it"
)


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    return write_good(tmp_path_factory.mktemp("corpus") / "good", SEED)


def chosen(cases: list[Case]) -> list[Case]:
    """All, or some of every kind: the same ones for the same seed."""
    if STRESSED:
        return cases
    kinds: dict[str, list[Case]] = defaultdict(list)
    for case in cases:
        kinds[case.name.split(":")[0]].append(case)
    draw, share = random.Random(SEED), SOME / len(cases)
    return [
        case
        for kind in kinds.values()
        for case in draw.sample(kind, min(len(kind), max(3, round(share * len(kind)))))
    ]


def complaint(case: Case, outcome: Outcome) -> str:
    """What is wrong with what came of a case; nothing where all is as it must be."""
    if not case.refused:
        return "" if outcome.status == 0 and "Traceback" not in outcome.error else "must be read"
    errors = [line for line in outcome.lines if line.startswith("phyradgs: ")]  # warnings have no such beginning
    if outcome.status != 2 or len(errors) != 1 or "Traceback" in outcome.error:
        return "must be refused in one line"
    if outcome.left:
        return f"left {outcome.left}"
    if outcome.seconds > SECONDS or outcome.megabytes > MEGABYTES:
        return "took too much"
    missing = [word for word in case.words if word not in outcome.error]
    return f"lacks {missing}" if missing else ""


def test_there_are_enough_and_each_has_a_name_of_its_own(good) -> None:
    cases = list(all_cases(good, SEED))
    assert len(cases) >= LEAST and len({case.name for case in cases}) == len(cases)
    assert sum(case.refused for case in cases) > 0.8 * len(cases)


def test_every_file_gets_its_verdict(good, tmp_path) -> None:
    runner, wrong = Runner(), []
    try:
        for number, case in enumerate(chosen(list(all_cases(good, SEED)))):
            folder = tmp_path / str(number)
            outcome = runner.run(case, good, folder)
            said = complaint(case, outcome)
            if said:
                wrong.append(f"{case.name}: {said}: {outcome}")
            assert not list(folder.rglob("canary")), f"{case.name}: something was executed"
            shutil.rmtree(folder)
    finally:
        runner.close()
    assert not wrong, "\n".join(wrong)
