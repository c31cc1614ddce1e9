"""estimate and --profile: what a run would take, and where one spent its time."""

import re
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from phyradgs_cl import estimate as room
from phyradgs_cl.estimate import duration, estimate
from phyradgs_cl.reconstructors import RunPlan, method_options, plan_run
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.workflow import load_scan

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scan(simulated) -> Path:
    return simulated("--phantom", "jaw", "--size", "12", "--detector", "16", "--views", "4", "--time-samples", "2")


@pytest.fixture
def clock(monkeypatch) -> SimpleNamespace:
    """A clock that only reconstructions move: 2 s each, ``each`` an iteration, ``control`` a round of control."""
    made = SimpleNamespace(now=0.0, each=0.25, control=0.0, iterations=[])
    made.perf_counter = lambda: made.now

    def run(scan, plan, rt) -> SimpleNamespace:
        options, iterations, rounds = plan.options, getattr(plan.options, "iterations", 1), 0
        made.iterations.append(iterations)
        if isinstance(options, SplatOptions):
            rounds = sum(options.control.is_due(i, iterations) for i in range(1, iterations + 1))
        made.now += 2.0 + iterations * made.each + rounds * made.control
        facts = {"density_control_rounds": rounds, "density_control_seconds": rounds * made.control}
        result = SimpleNamespace(facts=facts)
        result.complete = lambda: result
        return result

    monkeypatch.setattr(room, "time", made)
    monkeypatch.setattr(room, "reconstruct", run)
    return made


@pytest.fixture
def estimated(rt, scan):
    """(method, iterations) → the estimate of such a run."""

    def estimate_of(method: str, **changes: int) -> room.Estimate:
        return estimate(load_scan(scan), plan_run(method, changes), rt)

    return estimate_of


@pytest.mark.parametrize(
    ("method", "iterations", "each", "control"),
    [("r2", 7, 0.25, 0.0), ("r2", 3000, 0.25, 3.0), ("sirt", 400, 0.25, 0.0), ("sirt", 5000, 0.001, 0.0)],
)
def test_time_is_that_of_a_run_whose_iterations_are_alike(estimated, clock, method, iterations, each, control) -> None:
    """Rounds of density control count as often as they come; of passes of a millisecond, three say nothing."""
    clock.each, clock.control, rounds = each, control, 0
    if control:
        density_control = method_options(method, None, {"iterations": iterations}).control
        rounds = sum(density_control.is_due(i, iterations) for i in range(1, iterations + 1))
    found = estimated(method, iterations=iterations)
    assert found.seconds == pytest.approx(2.0 + each * iterations + control * rounds)
    assert found.iterations == iterations and found.seconds_per_iteration > 0 and (rounds > 10) == bool(control)
    assert sum(clock.iterations) <= 500 or each < 0.01 and max(clock.iterations) >= 100


def test_what_is_around_the_method_counts_and_fdk_is_run(rt, scan, clock, estimated) -> None:
    options = method_options("phyradgs", None, {"iterations": 300})
    found = estimate(load_scan(scan), RunPlan("phyradgs", options), rt, around=lambda result: 1.5)
    assert (found.seconds, found.around_s) == (pytest.approx(2.0 + 75 + 1.5), 1.5)
    assert "1.5 s to read, compare and write" in found.text()
    found = estimated("fdk")
    assert (found.seconds, found.iterations) == (2.25, 0) and "iterations" not in found.text()


def test_the_command_says_time_and_memory(told, scan, monkeypatch) -> None:
    monkeypatch.setattr("time.process_time", lambda: 1.5)  # to start and to read, which in this process was long ago
    text = told("estimate", scan, "--method fista-tv")
    assert text.startswith("fista-tv on ")
    assert re.search(r"^time +\S+ (s|min)", text, re.M) and int(re.search(r"^memory +(\d+) MiB", text, re.M)[1]) > 10
    whole, count, each, *others = re.findall(r"([\d.]+(?:e[+-]\d+)?) (?:s|ms|iterations)", text.splitlines()[1])
    rounding = 1.0 if float(whole) >= 10 else 0.05  # on a busy machine it takes so long, and is printed without decimals
    parts = int(count) * float(each) / 1e3 + sum(map(float, others))
    assert float(whole) == pytest.approx(parts, rel=0.05, abs=rounding), text
    assert text.endswith("\nblur at the rim: 2 px, at half radius 1 px\n")  # 14.4° of 8 columns


def test_the_words_of_reconstruct(cli, refused, scan, monkeypatch) -> None:
    """All that changes how long a run takes can be said to both."""
    monkeypatch.setattr("phyradgs_cl.commands.reconstruct.estimate", fake := Mock(side_effect=KeyboardInterrupt))
    before = ["--detector-model", "intensity", "--holdout", "3", "--set", "ignore_lag=true"]
    for words in (["--strips", "2", "--sub-intervals", "1"], ["--set", "segments=2", "--set", "time_error=0.01"]):
        cli.run(["estimate", str(scan), "--method", "phyradgs", *words, *before])
    plans = [call.args[1] for call in fake.call_args_list]
    for plan in plans:
        assert plan.options.detector_model == "intensity"
        assert (plan.preprocessing.holdout, plan.preprocessing.ignore_lag) == (3, True)
    micro, exact = (plan.options.motion for plan in plans)
    assert (micro.name, micro.strips, micro.sub_intervals) == ("micro-views", 2, 1)
    assert (exact.name, exact.segments, exact.time_error) == ("exact", 2, 0.01)
    refused(["estimate", scan, "--method", "phyradgs", "--motion", "per-row"], "--motion")


def test_profile_says_where_the_time_went(told, scan, tmp_path) -> None:
    line = f"reconstruct {scan} -o {tmp_path}/v --method phyradgs --motion static --iterations 5"
    text = told(line, "--profile")
    assert all(re.search(rf"^splat_{way}_(rows|pixels|group) +5 ", text, re.M) for way in ("forward", "backward"))
    assert "splat_forward" not in told(line)


def test_durations_for_people() -> None:
    for seconds, text in ((8.26, "8.26 s"), (260.0, "4 min 20 s"), (11100.0, "3 h 05 min")):
        assert duration(seconds) == text
