"""A number of a method that the scan chooses: where errors are least, once, and never against the user's own choice."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import compare, load_volume, prepare, reconstruct, save_scan, save_volume, simulate
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation
from phyradgs_cl.io import checkpoint_path
from phyradgs_cl.reconstructors import (
    Preprocessing,
    Progress,
    Reconstruction,
    RunPlan,
    method_options,
    plan_run,
)
from phyradgs_cl.reconstructors import reconstruct as run_method
from phyradgs_cl.reconstructors.projected import held_out
from phyradgs_cl.reconstructors.result import HELD_OUT, Report
from phyradgs_cl.reconstructors.tune import TUNED, trials
from phyradgs_cl.report.page import report_page
from phyradgs_cl.report.run import load_run

SOME = {"motion": "per-row", "sub_intervals": 2, "iterations": 24, "report": False}


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    usual = {"size": 16, "detector": 32, "views": 20, "exposure_deg": 8.0, "peak": 3.0, "noise": "beer", "dose": 1e3}
    return simulate("jaw", device=rt, **usual)


@pytest.fixture(scope="module")
def file(scan, tmp_path_factory) -> Path:
    save_scan(path := tmp_path_factory.mktemp("tune") / "scan.h5", scan)
    return path


def psnr_db(result, scan: Scan) -> float:
    return compare(result.volume, scan.reference)["psnr_db"]


def test_a_bad_weight_is_mended_by_the_scan(rt, scan) -> None:
    """From far below and from far above; what was chosen is what the run had, and what it would have been told."""
    given = {"method": "fista-tv", "device": rt, **SOME}
    usual = psnr_db(reconstruct(scan, **given), scan)
    for factor in (1 / 100, 100):
        bad = replace(method_options("fista-tv", None, {"motion": "per-row", "sub_intervals": 2}), iterations=24)
        bad = replace(bad, tv_weight=factor * bad.tv_weight)
        lost = psnr_db(run_method(scan, RunPlan("fista-tv", bad), rt), scan)
        mended = run_method(scan, RunPlan("fista-tv", bad, preprocessing=Preprocessing(tune="tv_weight")), rt)
        found = mended.facts[TUNED]
        assert mended.facts["options"]["tv_weight"] == found["chosen"] and mended.facts["options"]["iterations"] == 24
        assert psnr_db(mended, scan) > max(lost + 1, usual - 0.5), (factor, found)
    told = reconstruct(scan, **given, tv_weight=found["chosen"])
    np.testing.assert_array_equal(told.volume, mended.volume)


def test_a_trial_is_measured_with_the_motion_that_it_found(rt, scan, monkeypatch) -> None:
    field = Deformation(np.ones((1, 2, 2, 2, 3)), (0.0,) * 3, 1.0, np.zeros(1), np.ones((1, 1)))
    measured_with = []

    def errors(*arguments: object) -> dict[str, float]:
        measured_with.append(arguments[-1])
        return {"holdout_rms": 1.0, "holdout_noise_rms": 0.5, "holdout_pixels": 1}

    def run(scan: Scan, options: object, report: object) -> Reconstruction:
        return Reconstruction(np.zeros(scan.grid.shape, np.float32), scan.grid, deformation=field)

    monkeypatch.setattr(trials, "holdout_errors", errors)
    report = Report.of(lambda progress: None)
    result = trials.tuned("bending=0.01,0.02,0.04", run, scan, method_options("moving"), rt, report)
    assert measured_with == [field] * 3 and result.facts[TUNED]["option"] == "bending"


def test_the_choice_is_where_the_curve_is_least(rt, scan) -> None:
    """Of weights the largest, of iterations the fewest whose error is not far above that; of others the least itself."""
    weights = "prior_weight=.01,.05,.2,.4,.8,1.6,6.4"
    by_weight = reconstruct(scan, "fista", tune=weights, device=rt, subvoxels=1, report=False)
    followed = reconstruct(scan, "cgls", tune="iterations", device=rt, **{**SOME, "iterations": 60})
    for found in (by_weight.facts[TUNED], followed.facts[TUNED]):
        values, errors = np.array(found["values"]), np.array(found["holdout_rms"])
        best, chosen = values[errors.argmin()], found["chosen"]
        beyond = np.maximum(errors**2 - found["holdout_noise_rms"] ** 2, 0)
        at = np.interp(np.log(chosen), np.log(values), beyond) / beyond.min()
        assert found["holdout_pixels"] > 100 and found["holdout_noise_rms"] > 0 and found["seconds"] > 0
        assert errors[0] > errors.min() < errors[-1]
        if found["option"] == "iterations":
            assert values[0] < chosen < best and followed.facts["iterations"] == chosen and at < 1.8
            assert best < values[-1] < 60  # it is not followed on for nothing
        else:
            assert best < chosen < values[-1] and at < 1.13
    last = reconstruct(scan, "cgls", device=rt, **{**SOME, "iterations": int(values[-1])}, noise_stop=0.0)
    least = reconstruct(scan, "cgls", device=rt, **{**SOME, "iterations": int(best)}, noise_stop=0.0)
    assert psnr_db(followed, scan) > psnr_db(least, scan) > psnr_db(last, scan)


def test_a_run_that_goes_on_does_not_choose_again(rt, scan, file, cli, tmp_path, capsys) -> None:
    """In a file, by the command, and in Python: the same bits as one that was never stopped."""
    words = ["reconstruct", file, "--method", "fista-tv", "--iterations", "9", "--tune", "tv_weight"]
    assert cli.run([*map(str, words), "-o", str(tmp_path / "whole.h5")]) == 0
    said = capsys.readouterr().out
    whole = load_volume(tmp_path / "whole.h5")
    assert f"tv_weight {whole.facts[TUNED]['chosen']:.4g}, chosen from" in said and "held-out pixels" in said
    page = report_page(load_run(tmp_path / "whole.h5"))
    assert 'id="tuning"' in page and "Error over tv_weight" in page

    trials = []

    def stop(progress: Progress) -> None:
        trials.append("on trial" in progress.quantity)
        if progress.iteration == 5 and not trials[-1]:
            raise KeyboardInterrupt

    given = {"method": "fista-tv", "iterations": 9, "tune": "tv_weight", "device": rt}
    partial = reconstruct(scan, **given, report=stop, on_interrupt="return")
    assert any(trials) and TUNED in partial.state
    save_volume(tmp_path / "partial.h5", partial)
    trials.clear()
    for left in (partial, load_volume(tmp_path / "partial.h5")):
        rest = reconstruct(scan, **given, resume=left, report=lambda p: trials.append("on trial" in p.quantity))
        np.testing.assert_array_equal(rest.volume, whole.volume)
        assert rest.facts[TUNED] == partial.facts[TUNED] and not any(trials)
    with pytest.raises(InputError, match="resume: found a run with other input.tune"):
        reconstruct(scan, **{**given, "tune": "tv_weight=1,2,3"}, resume=partial)
    state = {**partial.state, TUNED: np.array(json.dumps({"option": 1}))}
    with pytest.raises(InputError, match="checkpoint"):
        reconstruct(scan, **given, resume=replace(partial, state=state))


def test_a_command_that_was_stopped_goes_on_with_its_choice(rt, file, tmp_path) -> None:
    from phyradgs_cl.workflow import run_reconstruction

    plan, output = plan_run("cgls", {"iterations": 30, "tune": "iterations"}), tmp_path / "volume.h5"

    def stop(progress: Progress) -> None:
        if "on trial" not in progress.quantity:
            raise KeyboardInterrupt

    stopped, _ = run_reconstruction(plan, file, output, lambda: rt, stop)
    assert checkpoint_path(output).is_file() and stopped.state is not None
    seen = []
    note = lambda p: seen.append(p.quantity)  # noqa: E731
    result, _ = run_reconstruction(plan, file, output, lambda: rt, note, resume=True)
    assert result.facts[TUNED] == stopped.facts[TUNED] and not any("on trial" in quantity for quantity in seen)
    assert result.facts["iterations"] == result.facts[TUNED]["chosen"]
    with h5py.File(output) as volume:
        assert json.loads(volume["entry/provenance/json"][()])[TUNED] == result.facts[TUNED]


def test_pixels_of_holdout_are_kept_from_trials_too(rt, scan) -> None:
    given = {"tune": "iterations", "holdout": 5.0, "report": False, "device": rt}
    shown, hidden = (reconstruct(some, "sart", **given) for some in (scan, _spoilt(scan)))
    assert shown.facts[TUNED]["holdout_rms"] == hidden.facts[TUNED]["holdout_rms"]
    np.testing.assert_array_equal(shown.volume, hidden.volume)
    assert hidden.facts[HELD_OUT]["holdout_rms"] > 1 > shown.facts[HELD_OUT]["holdout_rms"]


def _spoilt(scan: Scan) -> Scan:
    """The scan with absurd values in what holdout hides."""
    return replace(scan, projections=np.where(held_out(scan, 5.0), np.float32(7), scan.projections))


def test_a_trial_that_is_stopped_leaves_nothing(rt, scan) -> None:
    def stop(progress: Progress) -> None:
        raise KeyboardInterrupt

    for wish in ("relaxation", "iterations"):
        with pytest.raises(KeyboardInterrupt, match="before there was a volume"):
            reconstruct(scan, "sart", iterations=6, tune=wish, report=stop, device=rt)


REFUSED = {
    "no such option": ("fista-tv --tune wobble", "no number to choose of --method fista-tv", "tv_weight"),
    "nearly one": ("fista-tv --tune tv_wieght", "did you mean 'tv_weight'"),
    "no number": ("fista --tune prior", "no number to choose"),
    "a switch": ("fista --tune nonnegative", "no number to choose"),
    "no method with numbers": ("fdk --tune window", "a method with numbers"),
    "iterations that plan": ("fista --tune iterations", "no number to choose", "set --iterations"),
    "iterations by values": ("sart --tune iterations=1,2,3", "every iteration is looked at"),
    "two choices": ("fista-tv --tune tv_weight --set tv_weight=0.002", "leave one of the two out"),
    "too few values": ("fista-tv --tune tv_weight=1,2", "three different finite numbers or more"),
    "no values": ("fista-tv --tune tv_weight=a,b,c", "numbers with commas between"),
    "one value thrice": ("fista-tv --tune tv_weight=1,1,1", "three different finite numbers"),
    "parts of Gaussians": ("phyradgs --tune gaussians=1.5,2,3", "whole numbers"),
    "beyond the range": ("fista-tv --tune tv_weight=-1,0,1", "a number from 0"),
    "nothing about 0": ("sart --tune noise_stop", "nothing to try about it"),
    "no iterations": ("sart --tune iterations --iterations 0", "nothing to try about it"),
    "mixed pixels": ("fista-tv --tune tv_weight --median-filter 3", "median filter"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_chosen_is_refused_in_a_line(refused, file, tmp_path, case) -> None:
    words, *parts = REFUSED[case]
    refused(["reconstruct", file, "-o", tmp_path / "volume.h5", "--method", *words.split()], "--tune", *parts)
    assert not (tmp_path / "volume.h5").exists()


def test_python_refuses_it_without_a_method(rt, scan) -> None:
    with pytest.raises(InputError, match="^tune: found tv_weight, without a method"):
        prepare(scan, "sparks", device=rt, tune="tv_weight")
    assert "tune" not in Preprocessing().facts() and Preprocessing(tune="a").facts()["tune"] == "a"
