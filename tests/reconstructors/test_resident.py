"""The voxel methods on the device: nothing but numbers crosses the bus, the same bits twice, and what the host computes."""

from dataclasses import replace

import numpy as np
import pytest
from memory_limits import room_for
from tolerances import RESIDENT

from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors import METHODS, RunPlan, plan_run, reconstruct
from phyradgs_cl.reconstructors.splats.method import SplatRun
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import DeviceSpace, Runtime
from phyradgs_cl.runtime.layout import GUARD, pitch_of
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate

pytestmark = pytest.mark.slow

OPTIONS = {name: next(iter(method.presets.values())) for name, method in METHODS.items() if not method.finds_motion}
ITERATIVE = tuple(name for name, options in OPTIONS.items() if hasattr(options, "tolerance"))
"""But for methods that find a motion: their search works on the host, and their passes are those of fista."""
MOST_BYTES = 1024  # over the bus in an iteration
MOST_WAITS = dict.fromkeys(ITERATIVE, 8) | {"fista": 10}
GRID = Grid.cube(20, 2.0)


@pytest.fixture(scope="module")
def scan() -> Scan:
    """Read out along columns, with dead pixels: frames are turned, padded and masked on the way to the operators."""
    geometry = ConeGeometry(5.0, 7.0, (24, 28), (4 / 24, 4 / 28))
    options = SimulationOptions(Protocol(views=12, exposure_deg=24.0), "columns", detector_model="intensity", peak=3.0)
    mask = np.zeros((24, 28), np.uint8)
    mask[5:9, 11] = 1
    return replace(simulate(AnalyticSource(shepp_logan(1.0), geometry), geometry, GRID, options), pixel_mask=mask)


def plan_of(method: str, model: str, iterations: int = 3) -> RunPlan:
    changes = {"motion": "per-row", "sub_intervals": 2, "iterations": iterations, "detector_model": model}
    if method in ("fista", "fista-tv"):
        changes["transmission_weights"] = True
    if method == "cgls":
        changes["noise_stop"] = 0
    if method == "fista":  # one grid: between two the volume comes to the host, once
        changes |= {"subvoxels": 1, "prior": "dct"}  # ridge holds more slices than so small a volume has
    return plan_run(method, changes)


RUNS = [*((name, "intensity") for name in ITERATIVE), ("fista", "log"), ("sirt", "log")]


@pytest.mark.parametrize(("method", "model"), RUNS)
def test_a_run_on_the_device_and_one_on_the_host(rt, scan, monkeypatch, method, model) -> None:
    """Numbers alone cross the bus; the room that is asked for is enough and not far more than is used; the same bits twice.
    Where the device has too little room for all, the same lines over NumPy's arrays come to the same volume."""
    resident, volume_bytes, frames_bytes = System.resident, 4 * int(np.prod(GRID.shape)), scan.projections.nbytes
    spaces, asked = [], []

    def noted(self: System, rt: Runtime, volumes: int, frames: int) -> System:
        found = resident(self, rt, volumes, frames)
        spaces.append(found.space)
        more = (0, 0) if self.intensity is None else self.intensity.holds
        operators_bytes = rt.ledger.held_bytes - self.measured.nbytes
        asked.append(operators_bytes + (volumes + more[0]) * volume_bytes + (frames + more[1]) * frames_bytes)
        return found

    plan, seen = plan_of(method, model), []
    on_device = reconstruct(scan, plan, rt, report=lambda p: seen.append(replace(rt.traffic)))
    moved = np.diff([(t.bytes_up, t.bytes_down, t.blocking) for t in seen], axis=0)
    assert len(moved) == 2
    assert moved[:, 1].min() > 0, "the record has numbers, which somebody has to have asked for"
    assert moved[:, :2].sum(axis=1).max() <= MOST_BYTES and moved[:, 2].max() <= MOST_WAITS[method]
    assert rt.traffic.bytes_down - seen[-1].bytes_down == on_device.volume.nbytes

    monkeypatch.setattr(System, "resident", noted)
    with room_for(rt, 2**31):
        held_bytes, again = rt.ledger.held_bytes, reconstruct(scan, plan, rt)
        peak_bytes = rt.peak_bytes - held_bytes
    np.testing.assert_array_equal(again.volume, on_device.volume)
    assert 0.5 * asked[0] <= peak_bytes <= asked[0] - held_bytes
    with room_for(rt, int(0.9 * peak_bytes)):
        on_host = reconstruct(scan, plan, rt)
    assert [isinstance(space, DeviceSpace) for space in spaces] == [True, False]
    error = np.linalg.norm(on_host.volume - on_device.volume) / np.linalg.norm(on_host.volume)
    assert error <= RESIDENT[method]
    assert on_host.record[-1]["residual"] == pytest.approx(on_device.record[-1]["residual"], rel=1e-4)


def test_frames_of_fdk_go_up_once_and_its_volume_comes_down_once(scan) -> None:
    rt = Runtime()
    reconstruct(scan, plan_run("fdk", {"motion": "static"}), rt)
    (frames, lines, width), (nz, ny, nx) = scan.projections.shape, GRID.shape
    padded = max(lines * pitch_of(width), width * pitch_of(lines)) + 2 * GUARD  # columns may be made rows
    assert rt.traffic.bytes_up <= 4 * frames * (padded + 13)
    assert rt.traffic.bytes_down == 4 * (nz * ny * pitch_of(nx) + 2 * GUARD)
    assert rt.traffic.blocking == 4, "frames, poses, weights; the volume"


@pytest.mark.parametrize("method", ["phyradgs", "r2"])
def test_a_step_of_splats_waits_for_nothing(rt, scan, method, monkeypatch) -> None:
    """Between the first step, which learns how long lists are, and density control or a report."""
    waits, step = [], SplatRun.step

    def counted(self: SplatRun) -> None:
        before = self.rt.traffic.blocking
        step(self)
        waits.append(self.rt.traffic.blocking - before)

    monkeypatch.setattr(SplatRun, "step", counted)
    changes = {"exact_from": 0.0}  # another motion brings its cells
    changes |= {"gaussians": 200, "iterations": 8, "tv_edge": 8, "control": {"every": 0}}
    reconstruct(scan, plan_run(method, changes), rt)
    assert len(waits) == 8 and waits[0] == 3 and max(waits[1:]) == 0, "lists of frames and of the sub-volume, its axes"
