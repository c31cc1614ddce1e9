"""Measures the parts of a step of one reconstruction over ranks: kernels, host, sums over ranks, waiting. Predicts others.

    python benchmarks/mpi_scaling.py [--quick] [--ranks 1,2,3,4] [--json docs/results/mpi_scaling.json]

It needs the extra [mpi]. Every number of ranks is a run of mpiexec on this machine. Where the device is the processor, a
rank has one thread of PoCL, and times are processor seconds. The splats are exact in time, on 25 frames. Strong runs have
four frames per step for any number of ranks; weak runs have one frame per rank. For every part the least of the steps
counts, on the rank where it is largest. Waiting and whole steps are by the clock; waiting is a median. Both mean nothing
with more ranks than free processors.

The model of a step of B frames on R ranks:

    ceil(B / R) (kernels and host of a frame) + (kernels and host of a step) + sum of the gradients.

The parts come from the strong runs by least squares. The sum is 13 rows x 8 bytes x Gaussians through Allreduce. It takes
2 log2(R) latencies, and 2 (R - 1) / R times the bytes over the network's rate. The rate of this machine is measured."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Facts, finish, parser_of, splat_run, where

from phyradgs_cl.acquisition import ConeGeometry, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.optim import DensityControl
from phyradgs_cl.parallel import launched_ranks
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors.splats import step as splat_step
from phyradgs_cl.reconstructors.splats.method import SplatRun
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate

STRONG_BATCH, WARM = 4, 2
PARTS = ("step_ms", "kernels_ms", "host_ms", "sum_ms", "allreduce_ms", "idle_ms")
ONE_THREAD = {"POCL_MAX_PTHREAD_COUNT": "1", "OMP_NUM_THREADS": "1"}
NETWORKS = {
    "this machine's memory": None,
    "10 Gbit/s Ethernet": (1.25e9, 20e-6),
    "100 Gbit/s": (12.5e9, 2e-6),
    "400 Gbit/s": (50e9, 2e-6),
}
PREDICTED = (2, 4, 8, 16, 32, 64)


def started(rt: Runtime, gaussians: int, pixels: int, batch: int) -> SplatRun:
    """Returns a run of about this number of Gaussians, which stays constant."""
    geometry = ConeGeometry(5.0, 7.0, (pixels, pixels), (4.0 / pixels,) * 2)
    voxels = 16
    while voxels**3 < 8 * gaussians:  # a half of the voxels does not attenuate
        voxels += 16
    grid = Grid.cube(voxels, 2.0)
    options = SimulationOptions(make_protocol("rapid"), time_samples=2)
    scan = simulate(AnalyticSource(shepp_logan(1.0), geometry), geometry, grid, options)
    splats = SplatOptions(
        gaussians=gaussians, batch=batch, iterations=10**6, control=DensityControl(every=0), tv_edge=32
    )
    return splat_run(rt, scan, splats)


class Clock:
    """Seconds of this rank by part. On a CPU this is processor time, which other programs do not change.

    Kernels take the seconds of all threads but this one. On other devices, events time the kernels and the clock times the
    rest."""

    def __init__(self, rt: Runtime) -> None:
        self.rt, self.is_cpu = rt, rt.device.kind == "cpu"
        self.summing = self.sending = self.waiting = self.idle = 0.0
        self.own = time.thread_time if self.is_cpu else time.perf_counter

    def part(self, work: Callable[..., Any], name: str) -> Callable[..., Any]:
        """Returns ``work`` with its seconds added to the attribute ``name``."""

        def timed(*arguments: object) -> Any:
            begun = self.own()
            try:
                return work(*arguments)
            finally:
                setattr(self, name, getattr(self, name) + self.own() - begun)

        return timed

    def wait(self) -> None:
        """Waits until all ranks are here."""
        begun, sending = time.perf_counter(), self.sending
        self.part(self.rt.ranks.any, "waiting")(False)
        self.idle, self.sending = self.idle + time.perf_counter() - begun, sending

    def step(self, run: SplatRun) -> list[float]:
        """Takes one step. Returns its parts in seconds, in the order of PARTS."""
        self.summing = self.sending = self.waiting = self.idle = 0.0
        self.rt.kernel_uses()
        begun, own, whole = time.perf_counter(), self.own(), time.process_time()
        run.step()
        self.rt.finish()
        step, own, whole = time.perf_counter() - begun, self.own() - own, time.process_time() - whole
        kernels = whole - own if self.is_cpu else sum(use.seconds for use in self.rt.kernel_uses().values())
        host = own - self.summing - self.waiting - (0.0 if self.is_cpu else kernels)
        return [step, kernels, host, self.summing, self.sending, self.idle]


def measure(run: SplatRun, steps: int) -> tuple[np.ndarray, int]:
    """Returns (steps, parts) milliseconds of this rank, and the bytes that it hands over in a step."""
    ranks, clock = run.rt.ranks, Clock(run.rt)
    summing = clock.part(splat_step.exact_sum, "summing")

    def together(*arguments: object) -> np.ndarray:
        clock.wait()
        return summing(*arguments)

    splat_step.exact_sum = together  # type: ignore[assignment]
    for name in ("allreduce_sum", "allreduce_max"):
        setattr(ranks, name, clock.part(getattr(ranks, name), "sending"))
    rows = [clock.step(run) for _ in range(WARM)]
    before = ranks.sent_bytes
    rows = [clock.step(run) for _ in range(steps)]
    return 1e3 * np.array(rows), (ranks.sent_bytes - before) // steps


def be_a_rank(gaussians: int, pixels: int, batch: int, steps: int, device: str | None, out: Path) -> None:
    ranks = launched_ranks()
    rt = Runtime(device, profile=True, ranks=ranks)
    run = started(rt, gaussians, pixels, batch)
    rows, nbytes = measure(run, steps)
    everyone = ranks.allgather(rows[None])
    if ranks.rank == 0:
        facts = {
            "gaussians": run.cloud.count,
            "batch": batch,
            "ranks": ranks.size,
            "bytes_a_step": nbytes,
            "by_rank": [
                {
                    name: round(float((np.median if name == "idle_ms" else np.min)(rank[:, k])), 3)
                    for k, name in enumerate(PARTS)
                }
                for rank in everyone
            ],
        }
        out.write_text(json.dumps(facts))


def on_ranks(ranks: int, words: list[str]) -> Facts:
    """Returns the facts that rank 0 of ``ranks`` has written."""
    beside = Path(sys.executable).with_name("mpiexec")
    launcher = str(beside) if beside.exists() else "mpiexec"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.json"
        own = [sys.executable, "-m", "mpi4py", __file__, "--out", str(out), *words]
        subprocess.run([launcher, "-n", str(ranks), *own], check=True, env={**os.environ, **ONE_THREAD})
        return json.loads(out.read_text())


def slowest(facts: Facts, name: str) -> float:
    return max(rank[name] for rank in facts["by_rank"])  # type: ignore[attr-defined]


def exchange_share(facts: Facts) -> float:
    """Returns the time of sums over ranks, with their preparation, divided by that of a step without waiting."""
    parts = {name: slowest(facts, name) for name in PARTS}
    return parts["sum_ms"] / (parts["kernels_ms"] + parts["host_ms"] + parts["sum_ms"])


def predict(strong: list[Facts], batch: int) -> Facts:
    """Returns milliseconds of a step of ``batch`` frames by network and ranks, from the parts of the strong runs."""
    work = [slowest(facts, "kernels_ms") + slowest(facts, "host_ms") for facts in strong]
    frames = [-(-int(facts["batch"]) // int(facts["ranks"])) for facts in strong]  # type: ignore[call-overload]
    a_frame, a_step = np.polyfit(frames, work, 1) if len(set(frames)) > 1 else (work[0], 0.0)
    two = next(facts for facts in strong if facts["ranks"] == 2)
    nbytes, allreduce_s = int(two["bytes_a_step"]), 1e-3 * slowest(two, "allreduce_ms")  # type: ignore[call-overload]
    prepare_ms = slowest(two, "sum_ms") - slowest(two, "allreduce_ms")
    own_rate = nbytes / allreduce_s  # two ranks send 2 (R − 1) / R = 1 times the bytes
    found: Facts = {
        "frame_ms": round(float(a_frame), 2),
        "step_ms": round(float(max(a_step, 0.0)), 2),
        "prepare_sum_ms": round(prepare_ms, 2),
        "allreduce_bytes_per_s": round(own_rate),
        "fit_ms": [round(float(a_frame * n + a_step - w), 2) for n, w in zip(frames, work, strict=True)],
    }
    for name, network in NETWORKS.items():
        rate, latency_s = network or (own_rate, 0.0)
        steps = {}
        for ranks in PREDICTED:
            sending_ms = 1e3 * (2 * (ranks - 1) / ranks * nbytes / rate + 2 * np.log2(ranks) * latency_s)
            own = -(-batch // ranks)
            whole = own * a_frame + max(a_step, 0.0) + prepare_ms + sending_ms
            alone = batch * a_frame + max(a_step, 0.0)
            steps[str(ranks)] = {
                "step_ms": round(float(whole), 1),
                "exchange_share": round(float((prepare_ms + sending_ms) / whole), 4),
                "speed_up": round(float(alone / whole), 2),
            }
        found[name] = steps
    return found


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--ranks", default="1,2,3,4")
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--pixels", type=int, default=128)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--batch", type=int, default=0, help="frames per step of one run, within mpiexec")
    parser.add_argument("--out", type=Path, default=None, help="where rank 0 writes, within mpiexec")
    arguments = parser.parse_args()
    gaussians, pixels, steps = (
        (1000, 32, 3) if arguments.quick else (arguments.gaussians, arguments.pixels, arguments.steps)
    )
    if arguments.out:
        be_a_rank(gaussians, pixels, arguments.batch, steps, arguments.device, arguments.out)
        return
    sizes = [int(word) for word in arguments.ranks.split(",")]
    words = ["--gaussians", str(gaussians), "--pixels", str(pixels), "--steps", str(steps)]
    words += ["--device", arguments.device] if arguments.device else []
    facts: Facts = where(Runtime(arguments.device))
    facts |= {"pixels": pixels, "steps": steps, "motion": "exact", "threads_a_rank": 1}
    strong = [on_ranks(size, [*words, "--batch", str(STRONG_BATCH)]) for size in sizes]
    weak = [on_ranks(size, [*words, "--batch", str(size)]) for size in sizes]
    facts["strong"], facts["weak"] = strong, weak
    facts["exchange_share_of_two"] = round(exchange_share(next(f for f in weak if f["ranks"] == 2)), 4)
    facts["predicted_batch"] = max(PREDICTED)
    facts["predicted"] = predict(strong, max(PREDICTED))
    finish(facts, arguments.json)


if __name__ == "__main__":
    main()
