"""naf and sax-nerf as methods: better than FDK, motion known better than not, resumed to the same bits."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from parallel_kit import BODIES, parallel_scan

from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.api import Scan, compare, reconstruct, save_scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import checkpoint_path, read_volume
from phyradgs_cl.neural.field import first_field
from phyradgs_cl.neural.trainer import Trainer
from phyradgs_cl.parallel import Communicator
from phyradgs_cl.reconstructors import METHODS, RunPlan, method_options
from phyradgs_cl.reconstructors import reconstruct as run_method
from phyradgs_cl.reconstructors.loop import Loop
from phyradgs_cl.reconstructors.result import Progress, ignore_progress

NEURAL = ("naf", "sax-nerf")
SMALL = {"rays": 96, "levels": 2, "base_resolution": 8, "torch_device": "cpu"}
SHORT = {
    "naf": {**SMALL, "iterations": 3},
    "sax-nerf": {**SMALL, "iterations": 3, "window": 4, "windows": 3, "rays": 48},
}


def psnr(result, scan: Scan) -> float:
    return compare(result.volume, scan.reference)["psnr_db"]


@pytest.mark.parametrize(
    ("method", "rays", "passes", "over_fdk_db", "gain_db"), [("naf", 192, 20, 2, 1), ("sax-nerf", 128, 12, 2.2, 0.8)]
)
def test_a_field_beats_fdk_and_gains_from_the_motion(rt, scan, method, rays, passes, over_fdk_db, gain_db) -> None:
    same = {"rays": rays, "iterations": passes, "levels": 2, "torch_device": "cpu"}
    static = psnr(reconstruct(scan, method, device=rt, motion="static", **same), scan)
    assert static > psnr(reconstruct(scan, "fdk", device=rt, motion="static"), scan) + over_fdk_db
    for motion in [{"motion": "per-row"}, {"motion": "micro-views", "strips": 6}][: 2 if method == "naf" else 1]:
        moving = reconstruct(scan, method, device=rt, sub_intervals=3, **motion, **same)
        assert psnr(moving, scan) > static + gain_db


@pytest.mark.parametrize("method", NEURAL)
@pytest.mark.parametrize("stop", [1, 2])
def test_a_run_goes_on_from_any_report_to_the_same_bits(rt, scan, method, stop) -> None:
    options = method_options(method, None, {**SHORT[method], "motion": "per-row"})
    whole = run_method(scan, RunPlan(method, options), rt)

    def interrupt(progress: Progress) -> None:
        if progress.iteration == stop:
            raise KeyboardInterrupt

    part = run_method(scan, RunPlan(method, options), rt, report=interrupt)
    assert part.facts["interrupted_at"] == stop and part.state is not None
    rest = run_method(scan, RunPlan(method, options), rt, resume=part.state)
    assert np.array_equal(rest.volume, whole.volume)
    assert [x["loss"] for x in rest.record] == [x["loss"] for x in whole.record]


def small_run(scan: Scan) -> Loop:
    """Three passes of naf, not begun yet."""
    options = method_options("naf", None, SHORT["naf"])
    trainer = Trainer(scan, options, first_field(options, 16, 0), torch.device("cpu"), 1.0, 0)
    return Loop(trainer, Communicator(), ignore_progress, 0.0)


def test_a_run_goes_on_from_the_middle_of_a_pass(scan) -> None:
    """The state between two steps, as a signal leaves it."""
    whole, part, rest = small_run(scan), small_run(scan), small_run(scan)
    whole.run(None)
    for _ in range(scan.frames + 4):
        part.method.step()
    rest.run(part.state())
    assert np.array_equal(rest.method.present_volume()[0], whole.method.present_volume()[0])
    assert rest.record[-1]["loss"] == whole.record[-1]["loss"]


def test_a_damaged_state_is_refused(rt, scan) -> None:
    options = method_options("naf", None, SHORT["naf"])
    states = []
    run_method(scan, RunPlan("naf", options), rt, report=lambda p: states.append(dict(p.state())))
    wrong = {
        "parameters": np.zeros(3, np.float32), "moments": np.full_like(states[0]["moments"], np.nan),
        "steps": np.array(10**6), "updates": np.array(-1), "queue": states[0]["queue"] + 100,
        "losses": np.zeros(3), "rng": np.array("{}"),
    }  # fmt: skip
    for state in ({}, *({**states[0], name: value} for name, value in wrong.items())):
        with pytest.raises(InputError, match="checkpoint"):
            run_method(scan, RunPlan("naf", options), rt, resume=state)


@pytest.mark.parametrize("method", NEURAL)
def test_masked_pixels_do_not_matter(rt, scan, method) -> None:
    mask = np.zeros(scan.geometry.detector_shape, np.uint8)
    mask[3:9, 10:13] = 1
    one, two = (
        replace(scan, pixel_mask=mask, projections=np.where(mask, np.float32(garbage), scan.projections))
        for garbage in (0.0, 5.0)
    )
    volumes = [reconstruct(s, method, device=rt, **SHORT[method]).volume for s in (one, two)]
    assert np.array_equal(*volumes)


def test_lengths_and_attenuation_may_have_any_unit(rt, scan) -> None:
    """Lengths × 50 with attenuation ÷ 50: the same line integrals, the same picture."""
    geometry = scan.geometry.scaled(50.0)
    trajectory = replace(scan.trajectory, geometry=geometry)
    grid = scan.grid.scaled(50.0)
    far = replace(scan, geometry=geometry, trajectory=trajectory, grid=grid, reference=None)
    near = reconstruct(scan, "naf", device=rt, **SHORT["naf"])
    scaled = reconstruct(far, "naf", device=rt, **SHORT["naf"])
    assert np.allclose(50 * scaled.volume, near.volume, rtol=0.05, atol=0.01 * near.volume.max())


def test_the_intensity_model_takes_all_times(rt, scan) -> None:
    changes = {**SHORT["naf"], "motion": "per-row", "sub_intervals": 5, "detector_model": "intensity"}
    result = reconstruct(scan, "naf", device=rt, **changes)
    assert result.facts["detector_model"] == "intensity" and result.facts["times"] == 5
    changed = {**changes, "detector_model": "log", "times": 2}
    assert reconstruct(scan, "naf", device=rt, **changed).facts["times"] == 2


@pytest.mark.parametrize("method", NEURAL)
def test_the_published_constants_run(rt, scan, method) -> None:
    """One pass of the published configuration, its tables cut down to what a test can hold."""
    options = method_options(method, "published", {"iterations": 1, "table_log2": 12, "rays": 16})
    assert (options.rate, options.levels, options.jitter, options.positive_only) == (1e-3, 16, "sample", True)
    volume = run_method(scan, RunPlan(method, options), rt).volume
    assert np.isfinite(volume).all() and volume.min() >= 0


@pytest.mark.parametrize("method", NEURAL)
def test_from_file_to_file(rt, scan, method, tmp_path, capsys) -> None:
    assert METHODS[method].is_resumable and list(METHODS[method].presets) == ["default", "published"]
    save_scan(tmp_path / "scan.h5", scan)
    settings = [f"--set={name}={value}" for name, value in SHORT[method].items() if name != "iterations"]
    command = ["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "volume.h5"), "--method", method]
    assert load_cli().run([*command, *settings, "--iterations", "2", "--motion", "per-row"]) == 0
    assert "PSNR" in capsys.readouterr().out
    stored = read_volume(tmp_path / "volume.h5")
    assert stored.values.shape == scan.grid.shape
    assert stored.provenance["method"] == method
    assert not checkpoint_path(tmp_path / "volume.h5").exists()
    assert load_cli().run(["report", str(tmp_path / "volume.h5"), "-o", str(tmp_path / "page.html")]) == 0
    assert load_cli().run(["info", str(tmp_path / "volume.h5")]) == 0


def test_a_parallel_scan_is_reconstructed(rt) -> None:
    scan = parallel_scan(12)
    result = reconstruct(scan, "naf", device=rt, **{**SHORT["naf"], "iterations": 8})
    truth = BODIES.voxelise(scan.grid, 2)
    assert np.linalg.norm(result.volume - truth) < 0.8 * np.linalg.norm(truth)
