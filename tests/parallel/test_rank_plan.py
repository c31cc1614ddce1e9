"""estimate --ranks: bytes that the plan counts against those that ranks hold and hand over."""

from __future__ import annotations

from dataclasses import replace

import pytest

from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.acquisition import ConeGeometry, Motion, Protocol, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_scan
from phyradgs_cl.optim import DensityControl
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.rank_plan import plan_ranks
from phyradgs_cl.rank_plan.splats import SplatPlan
from phyradgs_cl.reconstructors import Progress, method_options, reconstruct
from phyradgs_cl.reconstructors.splat_options import SplatOptions
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate

FREE = DensityControl(every=0)
OPTIONS = SplatOptions(
    motion=Motion("micro-views", 4, 2), iterations=150, gaussians=900, tv_edge=8, control=FREE, batch=1
)
DIVIDED = {
    "frames": replace(OPTIONS, batch=4),
    "lines": replace(OPTIONS, parts=4),
    "exact in time": replace(OPTIONS, parts=4, motion=Motion("exact")),
    "domain": replace(OPTIONS, split="domain"),
    "domain, two frames a step": replace(OPTIONS, split="domain", batch=2),
    "domain, intensities": replace(OPTIONS, split="domain", detector_model="intensity"),
    "no total variation": replace(OPTIONS, batch=4, tv_weight=0.0, poisson_weight=1.0),
}


@pytest.fixture(scope="module")
def scan() -> Scan:
    geometry = ConeGeometry(5, 7.5, (24, 24), (3.9 / 24, 3.9 / 24))
    source = AnalyticSource(shepp_logan(1.0), geometry)
    protocol = Protocol(views=8, exposure_deg=20.0)
    return simulate(source, geometry, Grid.cube(16, 2.0), SimulationOptions(protocol))


class Between:
    """A report that counts what is handed over, and held, between the first and the second call."""

    def __init__(self, rt: Runtime) -> None:
        self.rt, self.exchanged, self.peak, self.gaussians, self.iterations = rt, 0, 0, 0, 0

    def note(self, iteration: int, gaussians: int) -> None:
        if not self.iterations:
            self.iterations, self.exchanged, self.gaussians = iteration, self.counted(), gaussians
            self.rt.reset_peak()
        elif not self.peak:
            self.iterations = iteration - self.iterations
            self.exchanged = self.counted() - self.exchanged
            self.peak = self.rt.peak_bytes

    def counted(self) -> int:
        return self.rt.ranks.exchanged_bytes

    def __call__(self, progress: Progress) -> None:
        self.note(progress.iteration, progress.gaussians)


def counted(ranks_of, size: int, scan: Scan, method: str, options) -> Between:
    """Of rank 0, which reports."""

    def work(ranks) -> Between:
        rt = Runtime(ranks=ranks)
        between = Between(rt)
        reconstruct(scan, method, rt, options, seed=1, report=between)
        return between

    return ranks_of(size, work)[0]


@pytest.mark.parametrize("name", DIVIDED)
def test_bytes_of_splats_are_those_that_are_counted(ranks_of, scan, name) -> None:
    options = DIVIDED[name]
    found = counted(ranks_of, 4, scan, "phyradgs", options)
    plan = SplatPlan(scan, options, 4)
    load = plan.load(found.gaussians)
    steps = found.iterations / plan.batch
    losses = (
        8 * plan.batch * (steps + 1)
    )  # are added up where there is a report or a record, in a step at most
    assert found.exchanged == pytest.approx(steps * load.exchange_bytes, abs=losses)
    # the plan is that of the rank with most cells
    assert 0.85 * load.device_bytes <= found.peak <= 1.1 * load.device_bytes


@pytest.mark.parametrize("method", ["sirt", "cgls", "os-sart", "asd-pocs", "fista-tv"])
def test_bytes_of_voxels_are_those_that_are_counted(ranks_of, scan, method) -> None:
    options = method_options(method, None, {"iterations": 4, "motion": "per-row"})
    found = counted(ranks_of, 4, scan, method, options)
    (load,) = plan_ranks(scan, method, options, 4).loads.values()
    assert found.exchanged == pytest.approx(found.iterations * load.exchange_bytes, rel=0.1)
    assert found.peak == pytest.approx(load.device_bytes, rel=0.1)


def test_gaussians_of_a_rank_shrink_with_the_number_of_ranks_in_the_domain_only(scan) -> None:
    def bytes_of(split: str, ranks: int) -> int:
        options = replace(OPTIONS, split=split, gaussians=100_000)
        return SplatPlan(scan, options, ranks).load(100_000).device["Gaussians with gradients and moments"]

    assert bytes_of("domain", 8) * 8 == pytest.approx(bytes_of("domain", 1), rel=0.01)
    assert bytes_of("frames", 8) == pytest.approx(bytes_of("frames", 1), rel=0.05)


def test_one_rank_exchanges_nothing(scan) -> None:
    assert "exchanged by a rank in a step of 1 frame" in plan_ranks(scan, "phyradgs", OPTIONS, 1).text()
    assert all(not load.exchange for load in plan_ranks(scan, "phyradgs", OPTIONS, 1).loads.values())


def test_more_ranks_than_parts_are_refused_before_anyone_starts_them(scan) -> None:
    with pytest.raises(InputError, match="at least 3"):
        plan_ranks(scan, "phyradgs", replace(OPTIONS, batch=2, parts=2), 5)


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (
            ["--ranks", "3", "--split", "domain", "--gaussians", "600"],
            0,
            "3 parts of the Gaussians by height",
        ),
        (["--ranks", "2", "--method", "fista-tv"], 0, "slab of the total variation"),
        (["--ranks", "2", "--method", "fdk"], 2, "leave --ranks out"),
        (["--ranks", "0"], 2, "--ranks: found 0"),
        (["--ranks", "2", "--device", "cpu"], 2, "a plan needs no device"),
        (["--ranks", "2", "--memory", "1GiB"], 0, "fits"),
        (["--ranks", "2", "--memory", "10M"], 0, "too much"),
    ],
)
def test_the_command_prints_the_plan_without_a_trial(
    scan, tmp_path, capsys, monkeypatch, words, status, said
) -> None:
    write_scan(tmp_path / "scan.h5", scan)
    monkeypatch.setattr("phyradgs_cl.commands.estimate.estimate", None)
    assert load_cli().run(["estimate", str(tmp_path / "scan.h5"), *words]) == status
    out, err = capsys.readouterr()
    assert said in (out if status == 0 else err)
