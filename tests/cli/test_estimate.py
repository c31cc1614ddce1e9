"""estimate and --profile: what a run would take, and where one spent its time."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from phyradgs_cl import estimate as room
from phyradgs_cl.estimate import duration, estimate, shortened
from phyradgs_cl.reconstructors import method_options
from phyradgs_cl.reconstructors.result import Reconstruction
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.workflow import load_scan

SIMULATE = ["simulate", "--phantom", "jaw", "--size", "12", "--detector", "16", "--views", "4"]


@pytest.fixture(scope="module")
def scan(simulated) -> Path:
    return simulated(*SIMULATE[1:], "--time-samples", "2")


class Clock:
    """A clock that only reconstructions move: ``start`` seconds each, ``each`` per iteration, ``control`` a round of density
    control; runs of over 100 iterations end with ``growth`` times the Gaussians."""

    def __init__(self, start: float, each: float, control: float = 0.0, growth: float = 1.0) -> None:
        self.now, self.start, self.each, self.iterations = 0.0, start, each, []
        self.control, self.growth = control, growth

    def perf_counter(self) -> float:
        return self.now

    def reconstruct(self, scan, method, rt, options, *, before=None) -> Reconstruction:
        iterations = getattr(options, "iterations", 1)
        self.iterations.append(iterations)
        rounds = 0
        if isinstance(options, SplatOptions):
            rounds = sum(options.control.is_due(i, iterations) for i in range(1, iterations + 1))
        self.now += self.start + iterations * self.each + rounds * self.control
        facts = {
            "density_control_rounds": rounds,
            "density_control_seconds": rounds * self.control,
            "gaussians_first": 100,
            "gaussians": 100 * (self.growth if iterations > 100 else 1),
        }
        return SimpleNamespace(facts=facts)


@pytest.fixture
def clock(monkeypatch) -> Clock:
    made = Clock(2.0, 0.25)
    monkeypatch.setattr(room, "time", made)
    monkeypatch.setattr(room, "reconstruct", made.reconstruct)
    return made


@pytest.mark.parametrize(("method", "iterations"), [("phyradgs", 3000), ("r2", 7), ("sirt", 40), ("sart", 1)])
def test_time_is_that_of_a_run_whose_iterations_are_alike(rt, scan, clock, method, iterations) -> None:
    options = method_options(method, None, {"iterations": iterations})
    found = estimate(load_scan(scan), method, options, rt)
    assert found.seconds == pytest.approx(2.0 + 0.25 * iterations)
    assert found.iterations == iterations and found.seconds_per_iteration > 0
    assert sum(clock.iterations) <= 500


@pytest.mark.parametrize(("method", "iterations"), [("phyradgs", 3000), ("sirt", 400)])
@pytest.mark.parametrize("slow", [1, 2, 3, 4])
def test_one_slow_trial_changes_nothing(rt, scan, clock, monkeypatch, method, iterations, slow) -> None:
    """The machine did something else for a while: the repeated trial tells."""

    def reconstruct(*args, **names) -> Reconstruction:
        clock.now += 50.0 * (len(clock.iterations) == slow)
        return clock.reconstruct(*args, **names)

    monkeypatch.setattr(room, "reconstruct", reconstruct)
    options = method_options(method, None, {"iterations": iterations})
    found = estimate(load_scan(scan), method, options, rt)
    assert found.seconds == pytest.approx(2.0 + 0.25 * iterations)


@pytest.mark.parametrize(("growth", "longest"), [(1.0, 200), (2.0, 600)])
def test_rounds_of_density_control_count_as_often_as_they_come(
    rt, scan, monkeypatch, growth, longest
) -> None:
    """A trial has as many rounds as the whole run in a fraction of its iterations; a cloud that grows has a longer trial."""
    made = Clock(2.0, 0.25, control=3.0, growth=growth)
    monkeypatch.setattr(room, "time", made)
    monkeypatch.setattr(room, "reconstruct", made.reconstruct)
    options = method_options("r2", None, {"iterations": 3000})
    control = options.control
    rounds = sum(control.is_due(i, 3000) for i in range(1, 3001))
    assert rounds > 10
    found = estimate(load_scan(scan), "r2", options, rt)
    assert found.seconds == pytest.approx(2.0 + 0.25 * 3000 + 3.0 * rounds)
    assert max(made.iterations) == longest


def test_a_method_that_may_stop_by_itself_is_run_if_that_is_short(rt, scan, clock) -> None:
    for iterations, is_run in ((60, True), (200, False)):
        clock.iterations.clear()
        estimate(load_scan(scan), "cgls", method_options("cgls", None, {"iterations": iterations}), rt)
        assert (clock.iterations[-1] == iterations) == is_run


def test_a_trial_goes_through_the_whole_schedule() -> None:
    options = method_options("phyradgs", None, {"iterations": 6000})
    trial = shortened(options, 200)
    share = trial.iterations / options.iterations
    assert trial.control.start_iteration == round(share * options.control.start_iteration)
    assert trial.parameter_terms_from == round(share * options.parameter_terms_from)
    assert any(trial.control.is_due(i, 200) for i in range(1, 201))
    assert replace(trial, iterations=6000, control=options.control, parameter_terms_from=500) == options
    still = replace(options, control=replace(options.control, every=0))
    assert shortened(still, 200).control.every == 0
    assert shortened(options, 9000) == options


def test_fast_iterations_are_told_from_noise(rt, scan, monkeypatch) -> None:
    """A pass of a millisecond: three of them say nothing, hundreds do."""
    made = Clock(2.0, 0.001)
    monkeypatch.setattr(room, "time", made)
    monkeypatch.setattr(room, "reconstruct", made.reconstruct)
    found = estimate(load_scan(scan), "sirt", method_options("sirt", None, {"iterations": 5000}), rt)
    assert max(made.iterations) >= 100
    assert found.seconds == pytest.approx(7.0)
    assert found.trial_iterations == sum(made.iterations)


def test_what_is_around_the_method_counts(rt, scan, clock) -> None:
    options = method_options("phyradgs", None, {"iterations": 300})
    found = estimate(load_scan(scan), "phyradgs", options, rt, around=lambda result: 1.5)
    assert (found.seconds, found.around_s) == (pytest.approx(2.0 + 75 + 1.5), 1.5)
    assert "1.5 s to read, compare and write" in found.text()


def test_what_has_no_iterations_is_run(rt, scan, clock) -> None:
    found = estimate(load_scan(scan), "fdk", method_options("fdk"), rt)
    assert (found.seconds, found.iterations) == (2.25, 0)
    assert "iterations" not in found.text()


def test_memory_is_what_a_run_holds(rt, scan) -> None:
    rt.reset_peak()
    before = rt.peak_bytes
    found = estimate(load_scan(scan), "sirt", method_options("sirt", None, {"iterations": 5}), rt)
    assert found.device_bytes > before
    assert found.host_bytes > 10_000_000


@pytest.mark.parametrize("method", ["phyradgs", "fista-tv", "fdk"])
def test_the_command_says_time_and_memory(cli, scan, capsys, method) -> None:
    assert cli.run(["estimate", str(scan), "--method", method]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"{method} on ")
    assert re.search(r"^time +\S+ (s|min)", text, re.M) and re.search(r"^memory +\d+ MiB", text, re.M)


@pytest.mark.parametrize(
    ("words", "name"), [(["--strips", "2", "--sub-intervals", "1"], "micro"), (["--segments", "2"], "exact")]
)
def test_the_words_of_reconstruct(cli, scan, monkeypatch, words, name) -> None:
    """All that changes how long a run takes can be said to both."""
    asked = []

    def fake(scan, method, options, rt, before, around):
        asked.append((options, before))
        raise KeyboardInterrupt

    monkeypatch.setattr("phyradgs_cl.commands.estimate.estimate", fake)
    more = ["--detector-model", "intensity", "--median-filter", "3", "--ignore-lag", "--time-error", "0.01"]
    cli.run(["estimate", str(scan), *words, *(more if name == "exact" else more[:-2])])
    options, before = asked[0]
    assert options.motion.name.startswith(name) and options.detector_model == "intensity"
    assert (before.median_filter, before.ignore_lag) == (3, True)
    wanted = (2, 1) if name == "micro" else (2, 0.01)
    motion = options.motion
    found = (motion.strips, motion.sub_intervals) if name == "micro" else (motion.segments, motion.time_error)
    assert found == wanted


def test_a_wrong_option_is_named_as_reconstruct_names_it(cli, scan, capsys) -> None:
    assert cli.run(["estimate", str(scan), "--motion", "per-row"]) == 2
    assert "--motion" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("seconds", "text"), [(8.26, "8.26 s"), (260.0, "4 min 20 s"), (11100.0, "3 h 05 min")]
)
def test_durations_for_people(seconds, text) -> None:
    assert duration(seconds) == text


def test_profile_says_where_the_time_went(cli, scan, tmp_path, capsys) -> None:
    output = str(tmp_path / "v.h5")
    assert (
        cli.run(
            ["reconstruct", str(scan), "-o", output, "--motion", "static", "--iterations", "5", "--profile"]
        )
        == 0
    )
    text = capsys.readouterr().out
    assert re.search(r"^splat_forward_rows +5 ", text, re.M) and re.search(r"^splat_backward_rows +5 ", text, re.M)
    assert "Gpairs/s" in text and "Gflop/s" in text
    assert cli.run(["reconstruct", str(scan), "-o", output, "--iterations", "5"]) == 0
    assert "Gpairs/s" not in capsys.readouterr().out
