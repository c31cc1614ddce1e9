"""Loops that users write: only scalars cross the bus, and the examples come near the methods."""

import importlib.util
import runpy
import sys
from pathlib import Path

import numpy as np
import pyopencl
import pyopencl.array
import pytest

from phyradgs_cl.api import Scan, compare, load_volume, ray_operator, reconstruct, save_scan, splat_operator
from phyradgs_cl.runtime import Runtime

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def bus(monkeypatch) -> list[int]:
    """Bytes that anybody copies between arrays of the host and the device, pyopencl's own included."""
    copied: list[int] = []
    whole = pyopencl.enqueue_copy

    def noted(queue: object, target: object, source: object, **options: object) -> object:
        copied.extend(array.nbytes for array in (target, source) if isinstance(array, np.ndarray))
        return whole(queue, target, source, **options)

    monkeypatch.setattr(pyopencl, "enqueue_copy", noted)
    return copied


@pytest.mark.parametrize("kind", ["rays", "ray intensity", "splats", "splat intensity"])
def test_a_loop_over_arrays_of_the_device_moves_scalars_alone(rt: Runtime, scan: Scan, cloud, bus, kind) -> None:
    of, detector = ray_operator if "ray" in kind else splat_operator, kind.partition(" ")[2]
    operator = getattr(of(scan, device=rt), detector) if detector else of(scan, device=rt)
    truth = scan.reference if "ray" in kind else cloud.rows()
    x, measured = operator.to_device(0.9 * truth), operator(operator.to_device(truth))
    y, pull = operator.vjp(x)
    step = 0.01 * float(np.abs(truth).max() / np.abs(pull(y - measured).get()).max())
    views = [(operator.frames([f]), measured[f : f + 1]) for f in range(scan.frames)]

    def one_pass() -> float:
        nonlocal x
        loss = 0.0
        for view, seen in views:
            y, pull = view.vjp(x)
            misfit = y - seen
            loss += float(pyopencl.array.dot(misfit, misfit).get())
            x -= step * pull(misfit)
        return loss

    first = one_pass()  # tables of the device's own go up once
    up, moved = rt.traffic.bytes_up, len(bus)
    assert one_pass() < first
    assert rt.traffic.bytes_up == up
    assert set(bus[moved:]) == {4} and len(bus) - moved <= 2 * len(views), "losses, and how long a list of splats is"


@pytest.mark.parametrize("example", ["own_sirt", "train_own"])
def test_an_example_comes_near_the_method(rt: Runtime, scan: Scan, tmp_path: Path, monkeypatch, capsys, example) -> None:
    if example == "train_own" and not importlib.util.find_spec("torch"):
        return
    monkeypatch.chdir(tmp_path)
    save_scan("scan.h5", scan)
    monkeypatch.setattr(sys, "argv", ["", "scan.h5", "30"])
    runpy.run_path(str(EXAMPLES / f"{example}.py"), run_name="__main__")
    volume = load_volume(f"{example}.h5").volume
    found = compare(volume, scan.reference)["psnr_db"]
    assert f"PSNR {found:.2f} dB" in capsys.readouterr().out
    method = {"own_sirt": "sirt", "train_own": "phyradgs"}[example]
    like = reconstruct(scan, method, iterations=30, device=rt).volume  # and sets negative voxels to 0
    assert found > compare(like, scan.reference)["psnr_db"] - 3
