"""The command line: parse, call, print. Every error is one line on stderr and exit status 2."""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from phyradgs_cl import __version__
from phyradgs_cl.bench import (
    KINDS,
    RESULTS,
    SIZES,
    BenchJob,
    BenchProgress,
    listed,
    listed_seeds,
    remake_tables,
    result_text,
    run_bench,
)
from phyradgs_cl.errors import OutputError, PhyradgsError
from phyradgs_cl.progress import Ticker
from phyradgs_cl.reconstructors import METHODS
from phyradgs_cl.reconstructors.interrupt import InterruptedAfterwards
from phyradgs_cl.runtime import DEVICE_VARIABLE, Runtime, choose_device, list_devices
from phyradgs_cl.runtime.context import default_lanes
from phyradgs_cl.settings import device_wish, file_parser, offset_pair, pulse_pair, run_settings
from phyradgs_cl.simulation import SimulationOptions
from phyradgs_cl.workflow import (
    ReconstructionJob,
    SimulationJob,
    load_scanner_for,
    make_scan_protocol,
    refuse_jitter,
    run_evaluation,
    run_reconstruction,
    run_simulation,
    summary,
)

INTERRUPTED = 130
_CLICK_ERROR: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


class Interrupted(Exception):
    """Ctrl-C before there was any output, on its way past Typer."""


class Commands(TyperGroup):
    """The commands. Typer would end Ctrl-C without a word; here it is handed on under another name."""

    def invoke(self, ctx: typer.Context) -> object:
        try:
            return super().invoke(ctx)
        except InterruptedAfterwards:
            raise typer.Exit(INTERRUPTED) from None
        except KeyboardInterrupt:
            raise Interrupted from None


app = typer.Typer(
    name="phyradgs",
    cls=Commands,
    add_completion=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Fly-scanning cone-beam CT: simulate scans, reconstruct them with motion known, measure the result.\n\n"
    "Exit status: 0 done, 2 wrong input or no device, 3 numbers that overflowed, 130 interrupted.",
)


class PhantomName(str, Enum):
    foot = "foot"
    jaw = "jaw"
    shepp_logan = "shepp-logan"
    spheres = "spheres"


class ProtocolName(str, Enum):
    rapid = "rapid"
    standard = "standard"
    static = "static"


class Axis(str, Enum):
    rows = "rows"
    columns = "columns"


class DetectorModel(str, Enum):
    log = "log"
    intensity = "intensity"


class Noise(str, Enum):
    none = "none"
    tigre = "tigre"
    beer = "beer"


MethodName = Enum("MethodName", {name: name for name in METHODS}, type=str)  # type: ignore[misc]


class MotionName(str, Enum):
    static = "static"
    static_start = "static-start"
    micro_views = "micro-views"
    per_row = "per-row"
    exact = "exact"


def file_option(*names: str, help: str, show_default: bool | str = True) -> Any:
    """An option that takes a file name."""
    parser = file_parser(names[-1])
    return typer.Option(*names, parser=parser, metavar="FILE", help=help, show_default=show_default)


def file_argument(name: str, help: str) -> Any:
    """An argument that is a file name."""
    return typer.Argument(parser=file_parser(name), help=help)


Device = Annotated[
    str | None,
    typer.Option(
        help=f"OpenCL device: index, cpu, gpu or part of a name (see 'phyradgs devices'); also ${DEVICE_VARIABLE}.",
        show_default="best by capability",
    ),
]
Output = Annotated[
    Path,
    file_option("--output", "-o", help="File to write; an existing one is replaced whole."),
]


@app.command(
    "simulate",
    epilog="Example: phyradgs simulate --phantom foot --size 64 --detector 128 --noise tigre -o scan.h5",
)
def simulate_command(
    output: Output,
    phantom: Annotated[
        PhantomName | None, typer.Option(help="Built-in phantom.", show_default="foot, without --volume")
    ] = None,
    volume: Annotated[
        Path | None,
        file_option("--volume", help="HDF5 file with a dataset /volume (z, y, x), or one of our volumes."),
    ] = None,
    scanner: Annotated[str, typer.Option(help="Scanner by name (r2, carm) or a TOML file.")] = "r2",
    protocol: Annotated[
        ProtocolName,
        typer.Option(
            help="rapid: 25 frames of 14.4°; standard: 50 of 7.2°; static: stop-and-shoot at the mid-window poses of "
            "rapid, or of the fly-scan that the options below describe."
        ),
    ] = ProtocolName.rapid,
    views: Annotated[int | None, typer.Option(help="Frames in the turn.", show_default="protocol's")] = None,
    exposure_deg: Annotated[
        float | None, typer.Option(help="Arc of one exposure, degrees.", show_default="protocol's")
    ] = None,
    readout_ratio: Annotated[
        float | None, typer.Option(help="Readout over exposure time, T_ro/T_exp.", show_default="0.86")
    ] = None,
    start_deg: Annotated[
        float | None, typer.Option(help="Gantry angle at the start, degrees.", show_default="0")
    ] = None,
    readout: Annotated[
        Axis | None, typer.Option(help="What is read out at one time.", show_default="scanner's")
    ] = None,
    readout_direction: Annotated[
        int | None, typer.Option(help="1 reads index 0 first, -1 last.", show_default="scanner's")
    ] = None,
    pulse: Annotated[
        str | None,
        typer.Option(
            metavar="START,LENGTH",
            help="When the beam is on, after a frame's start, in shares of the exposure.",
            show_default="scanner's: always on",
        ),
    ] = None,
    lag: Annotated[
        float | None,
        typer.Option(
            help="Share of a recorded frame that comes from the frames before, 0 to 0.9.",
            show_default="scanner's: 0",
        ),
    ] = None,
    detector_model: Annotated[
        DetectorModel,
        typer.Option(help="Average line integrals (log) or transmitted intensity over the exposure."),
    ] = DetectorModel.log,
    peak: Annotated[
        float, typer.Option(help="Scale attenuation so that the largest line integral is this; 0 leaves it.")
    ] = 0.0,
    noise: Annotated[
        Noise,
        typer.Option(
            help="tigre: TIGRE's rescaled Poisson; beer: Beer-Lambert counts; both plus electronic noise."
        ),
    ] = Noise.none,
    dose: Annotated[float, typer.Option(help="Photons a pixel without object.")] = 1e4,
    electronic_noise: Annotated[
        float, typer.Option(help="Standard deviation of electronic noise, counts.")
    ] = 10.0,
    jitter_deg: Annotated[
        float | None,
        typer.Option(
            help="Wander of the gantry about constant speed (std, degrees), written to the encoder table.",
            show_default="0",
        ),
    ] = None,
    detector: Annotated[
        int | None,
        typer.Option(
            help="Detector columns (rows in proportion); the panel keeps its size.", show_default="scanner's"
        ),
    ] = None,
    detector_offset: Annotated[
        str | None, typer.Option(help="Detector offset V,U in mm.", show_default="scanner's")
    ] = None,
    size: Annotated[
        int | None,
        typer.Option(
            help="Voxels along the longest side of the grid and truth.",
            show_default="scanner's or the file's",
        ),
    ] = None,
    time_samples: Annotated[
        int,
        typer.Option(help="Times at which every line is projected in its exposure; 0 chooses by the motion."),
    ] = 0,
    seed: Annotated[int, typer.Option(help="Seed of phantom, noise and jitter.")] = 0,
    device: Device = None,
) -> None:
    """Simulate a fly-scan (or a stop-and-shoot one) of a phantom or a volume, and write a scan file."""
    readout_axis = readout.value if readout else None
    refuse_jitter(protocol.value, jitter_deg)
    wish = device_wish(device)
    job = SimulationJob(
        output,
        phantom.value if phantom else None,
        volume,
        scanner,
        detector,
        offset_pair("--detector-offset", detector_offset),
        size,
    )
    described = load_scanner_for(job)
    options = SimulationOptions(
        protocol=make_scan_protocol(
            protocol.value,
            described,
            views=views,
            exposure_deg=exposure_deg,
            readout_ratio=readout_ratio,
            pulse=pulse_pair("--pulse", pulse),
            start_deg=start_deg,
        ),
        readout_axis=readout_axis or described.readout_axis,
        readout_direction=described.readout_direction if readout_direction is None else readout_direction,
        detector_model=detector_model.value,
        peak=peak,
        noise=noise.value,
        dose=dose,
        electronic_noise=electronic_noise,
        jitter_deg=0.0 if jitter_deg is None else jitter_deg,
        lag=described.lag if lag is None else lag,
        time_samples=time_samples,
        seed=seed,
    )
    with Ticker("frame") as ticker:
        scan = run_simulation(job, described, options, Runtime(wish), ticker.show)
    frames, rows, columns = scan.projections.shape
    say(f"{output}: {frames} frames of {rows}×{columns}, largest line integral {scan.projections.max():.3g}")


@app.command(
    "reconstruct",
    epilog="Example: phyradgs reconstruct scan.h5 -o volume.h5 --iterations 2000\n\n"
    "Ctrl-C keeps what there is and leaves a checkpoint; --resume goes on from it.",
)
def reconstruct_command(
    scan: Annotated[Path, file_argument("SCAN", "Scan file (HDF5, NXtomo).")],
    output: Output,
    method: Annotated[
        MethodName | None,  # type: ignore[valid-type]
        typer.Option(
            help="phyradgs: exact splats; r2: R2-Gaussian's affine splats; fdk: analytic; "
            "the others are iterative on voxels.",
            show_default="phyradgs",
        ),
    ] = None,
    motion: Annotated[
        MotionName | None,
        typer.Option(
            help="How frames see the moving gantry: frozen at mid-window (static), at the start, M×N micro-views, "
            "every line at its own times (per-row), or splats that move while lines integrate (exact); "
            "not every method has all of them.",
            show_default="micro-views for phyradgs, else static",
        ),
    ] = None,
    strips: Annotated[
        int | None, typer.Option(help="Strips M of a frame (rolling shutter).", show_default="8")
    ] = None,
    sub_intervals: Annotated[
        int | None, typer.Option(help="Sub-intervals N of an exposure (motion blur).", show_default="5")
    ] = None,
    segments: Annotated[
        int | None,
        typer.Option(help="Segments of a frame (motion exact); 0: by the time error.", show_default="0"),
    ] = None,
    time_error: Annotated[
        float | None,
        typer.Option(
            help="Relative error that averaging over time may leave (motion exact).", show_default="0.005"
        ),
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(
            help="Iterations: one frame each for splats, all frames for voxels.",
            show_default="preset's: 3000 for splats",
        ),
    ] = None,
    gaussians: Annotated[
        int | None, typer.Option(help="Gaussians at the start.", show_default="preset's: from the grid")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of cloud, frame order and sub-volumes.", show_default="0")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="Constants: default, paper or released (phyradgs); published (r2); the window of fdk.",
            show_default="the method's first",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        file_option(
            "--config",
            help="TOML file with any of these options (underscores for dashes) and the preset's constants; "
            "the command line wins.",
        ),
    ] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Any option of the method by name, as in the file: --set tv_weight=0.002 --set order=random. "
            "Docs: methods.md.",
        ),
    ] = None,
    detector_model: Annotated[
        DetectorModel | None,
        typer.Option(
            help="What is averaged over an exposure: line integrals (log) or intensity; iterative methods.",
            show_default="the scan's",
        ),
    ] = None,
    ignore_lag: Annotated[
        bool, typer.Option("--ignore-lag", help="Leave the lag that the scan file states in the frames.")
    ] = False,
    median_filter: Annotated[
        int | None,
        typer.Option(help="Median filter of the frames: 3 or 5 pixels a side, 0 none.", show_default="0"),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the checkpoint of an interrupted run.")
    ] = False,
    device: Device = None,
) -> None:
    """Reconstruct a scan into a volume; say PSNR and SSIM if the scan carries the truth."""
    given = {
        "method": method.value if method else None,  # type: ignore[attr-defined]
        "motion": motion.value if motion else None,
        "strips": strips,
        "sub_intervals": sub_intervals,
        "segments": segments,
        "time_error": time_error,
        "iterations": iterations,
        "gaussians": gaussians,
        "seed": seed,
        "preset": preset,
        "detector_model": detector_model.value if detector_model else None,
        "ignore_lag": True if ignore_lag else None,
        "median_filter": median_filter,
        "device": device,
    }
    settings = run_settings(config, given, assignments or [])
    job = ReconstructionJob(
        scan,
        output,
        method=settings.method,
        seed=settings.seed,
        preset=settings.preset,
        changes=settings.changes,
        resume=resume,
        config=config,
        before=settings.before,
    )
    with Ticker("iteration") as ticker:
        result, metrics = run_reconstruction(job, lambda: Runtime(settings.device), ticker.progress)
    interrupted = result.facts.get("interrupted_at")
    say(f"{output}: {job.method}, {result.facts['seconds']:.1f} s" + _metrics_text(metrics))
    if interrupted is not None:
        complain(f"interrupted after iteration {interrupted}: repeat the command with --resume to go on")
        raise typer.Exit(INTERRUPTED)


@app.command("evaluate", epilog="Example: phyradgs evaluate volume.h5 --reference scan.h5 --json")
def evaluate_command(
    volume: Annotated[Path, file_argument("VOLUME", "Volume file.")],
    reference: Annotated[
        Path,
        file_option("--reference", help="Scan with a known truth, or a volume on the same grid."),
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    picture: Annotated[
        Path | None,
        file_option(
            "--picture",
            help="PNG of slices: result, truth, difference.",
            show_default="VOLUME with .png",
        ),
    ] = None,
) -> None:
    """Measure a volume against the truth: 3D PSNR and SSIM, and a picture of slices."""
    facts = run_evaluation(volume, reference, picture or volume.with_suffix(".png"))
    if as_json:
        say(json.dumps(facts))
    else:
        say(f"PSNR {facts['psnr_db']:.2f} dB   SSIM {facts['ssim']:.4f}   picture {facts['picture']}")


BenchKind = Enum("BenchKind", {name: name for name in KINDS}, type=str)  # type: ignore[misc]
SizeName = Enum("SizeName", {name: name for name in SIZES}, type=str)  # type: ignore[misc]


@app.command(
    "bench",
    epilog="Example: phyradgs bench table1 --volumes VOLUMES -o results --size S --seeds 0,1,2\n\n"
    "Runs that the results file in the folder has already are not made again: interrupt and repeat at will.",
)
def bench_command(
    kind: Annotated[
        BenchKind,  # type: ignore[valid-type]
        typer.Argument(
            help="table1: all methods, 25 and 50 views; table2: PhyRadGS over M and N; phantom: the paper's sphere "
            "phantom against a pseudo-truth; quick: few methods on two small volumes, some minutes.",
        ),
    ],
    volumes: Annotated[
        Path | None,
        typer.Option(
            parser=file_parser("--volumes"),
            metavar="DIR",
            help="Folder of HDF5 files NAME_COUNT.h5 or NAME.h5 with a dataset /volume; each is projected at its own "
            "resolution.",
            show_default="the built-in foot and jaw",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            parser=file_parser("-o"),
            metavar="DIR",
            help=f"Folder for {RESULTS} (a line a run), tables, figures and slices.",
            show_default="bench-results",
        ),
    ] = None,
    size: Annotated[
        SizeName | None,  # type: ignore[valid-type]
        typer.Option(
            help="; ".join(
                f"{s.name}: {s.voxels}³ from {s.pixels}², {s.iterations:,} iterations" for s in SIZES.values()
            ),
            show_default="S; M for phantom, XS for quick",
        ),
    ] = None,
    names: Annotated[
        str | None,
        typer.Option(help="Volumes, with commas.", show_default="all; the first two for quick"),
    ] = None,
    rows: Annotated[
        str | None,
        typer.Option(
            help="Rows by their label in the table, with commas; a wrong one lists all.", show_default="all"
        ),
    ] = None,
    protocols: Annotated[
        str | None,
        typer.Option(
            help="rapid (25 views) and standard (50), with commas.",
            show_default="both for table1, else rapid",
        ),
    ] = None,
    seeds: Annotated[
        str, typer.Option(help="Seeds of noise, jitter, cloud and frame order, with commas.")
    ] = "0",
    iterations: Annotated[
        int | None, typer.Option(help="Iterations of the splatting methods.", show_default="the size's")
    ] = None,
    readout: Annotated[Axis, typer.Option(help="What is read out at one time.")] = Axis.rows,
    table_only: Annotated[
        bool, typer.Option("--table-only", help="Make tables and figures from the results file, run nothing.")
    ] = False,
    device: Device = None,
) -> None:
    """Compare methods on volumes: a resumable results file, tables in Markdown and CSV, figures of slices."""
    job = BenchJob(
        kind.value,  # type: ignore[attr-defined]
        output or Path("bench-results"),
        volumes,
        size.value if size else None,  # type: ignore[attr-defined]
        listed("--names", names),
        listed("--protocols", protocols),
        listed("--rows", rows),
        listed_seeds("--seeds", seeds),
        iterations,
        readout.value,
    )
    wish = device_wish(device)
    try:
        written = remake_tables(job) if table_only else run_bench(job, lambda: Runtime(wish), BenchTicker())
    except KeyboardInterrupt:
        complain(
            f"interrupted: finished runs are in {job.output / RESULTS}; repeat the command to go on",
            INTERRUPTED,
        )
        raise typer.Exit(INTERRUPTED) from None
    for path in written:
        say(str(path))


class BenchTicker:
    """Progress of a benchmark: a counter for each run, and its result once it is done."""

    def __init__(self) -> None:
        self.title = ""
        self.ticker = Ticker("")

    def __call__(self, p: BenchProgress) -> None:
        if p.title != self.title:
            self.title = p.title
            self.ticker = Ticker(f"{p.number}/{p.runs} {p.title}: iteration")
        if p.line is not None:
            with self.ticker:  # ends the line that it rewrites
                pass
            say(result_text(p))
        elif p.iterations:
            self.ticker.show(p.iteration, p.iterations)


@app.command("info", epilog="Example: phyradgs info scan.h5")
def info_command(
    file: Annotated[Path, file_argument("FILE", "Scan or volume file.")],
) -> None:
    """Say what a file holds."""
    for key, value in summary(file).items():
        say(f"{key.replace('_', ' '):24s} {value}")


@app.command("devices", epilog="Example: phyradgs devices --device cpu")
def devices_command(device: Device = None) -> None:
    """List OpenCL devices and say which one is taken, and why."""
    chosen, reason = choose_device(device_wish(device))
    for d in list_devices():
        mark = "*" if d.index == chosen.index else " "
        never = "" if d.by_default else ", only when asked for"
        say(
            f"{mark} {d.index}: {d.name} ({d.kind}; {d.platform}), {d.compute_units} units, vector width {default_lanes(d)} "
            f"of {d.vector_width}, {d.memory_bytes / 2**30:.1f} GiB, at most {d.largest_allocation_bytes / 2**30:.1f} GiB "
            f"at once, float64 {'yes' if d.has_fp64 else 'no'}{never}"
        )
        say(f"     {d.version}")
    say(f"takes {chosen.index}: {reason}")


@app.callback(invoke_without_command=True)
def root(
    ctx: typer.Context, version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False
) -> None:
    if version:
        say(f"phyradgs-cl {__version__}")
        raise typer.Exit
    if ctx.invoked_subcommand is None:
        say(ctx.get_help())


def run(arguments: list[str]) -> int:
    """Runs one command; the exit status."""
    try:
        status = app(arguments, standalone_mode=False)
        return status if isinstance(status, int) else 0
    except PhyradgsError as error:
        return complain(str(error), error.exit_code)
    except MemoryError as error:
        return complain(f"not enough memory: {error}; use a smaller problem")
    except _CLICK_ERROR as error:
        return complain(str(error.format_message()))  # type: ignore[attr-defined]
    except OSError as error:  # one that no reader or writer has named
        return complain(f"{error.filename or 'operating system'}: {error.strerror or error}")
    except (Interrupted, KeyboardInterrupt, typer.Abort):
        return complain("interrupted, nothing written", INTERRUPTED)


def say(text: str) -> None:
    """One result on stdout."""
    try:
        typer.echo(text)
    except BrokenPipeError:  # Typer ends quietly, as `| head` wants it
        raise
    except OSError as error:
        _give_up_stdout()
        found = error.strerror or str(error)
        raise OutputError("standard output", found, "somewhere with room to write to") from error


def complain(text: str, status: int = 2) -> int:
    """One line on stderr; the exit status to end with."""
    with suppress(OSError):  # nobody is left to be told
        typer.echo("phyradgs: " + " ".join(text.split()), err=True)
    return status


def _give_up_stdout() -> None:
    """What could not be written would be tried again at the interpreter's end, with a traceback."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _metrics_text(metrics: dict[str, float]) -> str:
    return f", PSNR {metrics['psnr_db']:.2f} dB, SSIM {metrics['ssim']:.4f}" if metrics else ""
