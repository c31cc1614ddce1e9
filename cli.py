"""The command line: parse, call, print. Every error is one line on stderr and exit status 2."""

from __future__ import annotations

import json
import sys
import time
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from phyradgs_cl import __version__
from phyradgs_cl.errors import InputError, PhyradgsError
from phyradgs_cl.reconstructors import METHODS, Progress
from phyradgs_cl.runtime import DEVICE_VARIABLE, Runtime, choose_device, list_devices
from phyradgs_cl.runtime.context import default_lanes
from phyradgs_cl.simulation import SimulationOptions
from phyradgs_cl.workflow import (
    ReconstructionJob,
    SimulationJob,
    load_scanner_for,
    make_scan_protocol,
    run_evaluation,
    run_reconstruction,
    run_simulation,
    summary,
)

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

INTERRUPTED = 130
_CLICK_ERROR: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

app = typer.Typer(
    name="phyradgs",
    no_args_is_help=True,
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


Device = Annotated[
    str | None,
    typer.Option(
        help=f"OpenCL device: index, cpu, gpu or part of a name (see 'phyradgs devices'); also ${DEVICE_VARIABLE}.",
        show_default="best by capability",
    ),
]
Output = Annotated[
    Path, typer.Option("--output", "-o", help="File to write; an existing one is replaced whole.")
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
        Path | None, typer.Option(help="HDF5 file with a dataset /volume (z, y, x), or one of our volumes.")
    ] = None,
    scanner: Annotated[str, typer.Option(help="Scanner by name (r2, carm) or a TOML file.")] = "r2",
    protocol: Annotated[
        ProtocolName,
        typer.Option(
            help="rapid: 25 frames of 14.4°; standard: 50 of 7.2°; static: stop-and-shoot, 25 mid-window poses."
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
        float,
        typer.Option(
            help="Wander of the gantry about constant speed (std, degrees), written to the encoder table."
        ),
    ] = 0.0,
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
    job = SimulationJob(
        output,
        phantom.value if phantom else None,
        volume,
        scanner,
        detector,
        _pair("--detector-offset", detector_offset),
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
            start_deg=start_deg,
        ),
        readout_axis=readout.value if readout else described.readout_axis,
        readout_direction=described.readout_direction if readout_direction is None else readout_direction,
        detector_model=detector_model.value,
        peak=peak,
        noise=noise.value,
        dose=dose,
        electronic_noise=electronic_noise,
        jitter_deg=jitter_deg,
        time_samples=time_samples,
        seed=seed,
    )
    with Ticker("frame") as ticker:
        scan = run_simulation(
            job, described, options, Runtime(device), lambda done, total: ticker.show(done, total)
        )
    frames, rows, columns = scan.projections.shape
    typer.echo(
        f"{output}: {frames} frames of {rows}×{columns}, largest line integral {scan.projections.max():.3g}"
    )


@app.command(
    "reconstruct",
    epilog="Example: phyradgs reconstruct scan.h5 -o volume.h5 --iterations 2000\n\n"
    "Ctrl-C keeps what there is and leaves a checkpoint; --resume goes on from it.",
)
def reconstruct_command(
    scan: Annotated[Path, typer.Argument(help="Scan file (HDF5, NXtomo).")],
    output: Output,
    method: Annotated[
        MethodName | None,  # type: ignore[valid-type]
        typer.Option(
            help="phyradgs: exact splats; r2: R2-Gaussian's affine splats; fdk: analytic.",
            show_default="phyradgs",
        ),
    ] = None,
    motion: Annotated[
        MotionName | None,
        typer.Option(
            help="How frames see the moving gantry: frozen at mid-window (static), at the start, or M×N micro-views.",
            show_default="micro-views for phyradgs, static for r2 and fdk",
        ),
    ] = None,
    strips: Annotated[
        int | None, typer.Option(help="Strips M of a frame (rolling shutter).", show_default="8")
    ] = None,
    sub_intervals: Annotated[
        int | None, typer.Option(help="Sub-intervals N of an exposure (motion blur).", show_default="5")
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Iterations, one frame each.", show_default="preset's: 3000")
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
            help="Constants: default, paper or released (phyradgs); published (r2).", show_default="default"
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            help="TOML file with any of these options (underscores for dashes) and the preset's constants; "
            "the command line wins."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the checkpoint of an interrupted run.")
    ] = False,
    device: Device = None,
) -> None:
    """Reconstruct a scan into a volume; say PSNR and SSIM if the scan carries the truth."""
    settings = _read_config(config)
    given = {
        "method": method.value if method else None,  # type: ignore[attr-defined]
        "motion": motion.value if motion else None,
        "strips": strips,
        "sub_intervals": sub_intervals,
        "iterations": iterations,
        "gaussians": gaussians,
        "seed": seed,
        "preset": preset,
        "device": device,
    }
    settings.update({key: value for key, value in given.items() if value is not None})
    wish = settings.pop("device", None)
    job = ReconstructionJob(
        scan,
        output,
        method=str(settings.pop("method", "phyradgs")),
        seed=_seed(settings.pop("seed", 0)),
        preset=settings.pop("preset", None),
        changes=settings,
        resume=resume,
    )
    with Ticker("iteration") as ticker:
        result, metrics = run_reconstruction(job, lambda: Runtime(wish), ticker.progress)
    interrupted = result.facts.get("interrupted_at")
    typer.echo(f"{output}: {job.method}, {result.facts['seconds']:.1f} s" + _metrics_text(metrics))
    if interrupted is not None:
        typer.echo(
            f"interrupted after iteration {interrupted}: repeat the command with --resume to go on", err=True
        )
        raise typer.Exit(INTERRUPTED)


@app.command("evaluate", epilog="Example: phyradgs evaluate volume.h5 --reference scan.h5 --json")
def evaluate_command(
    volume: Annotated[Path, typer.Argument(help="Volume file.")],
    reference: Annotated[Path, typer.Option(help="Scan with a known truth, or a volume on the same grid.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    picture: Annotated[
        Path | None,
        typer.Option(help="PNG of slices: result, truth, difference.", show_default="VOLUME with .png"),
    ] = None,
) -> None:
    """Measure a volume against the truth: 3D PSNR and SSIM, and a picture of slices."""
    facts = run_evaluation(volume, reference, picture or volume.with_suffix(".png"))
    if as_json:
        typer.echo(json.dumps(facts))
    else:
        typer.echo(f"PSNR {facts['psnr_db']:.2f} dB   SSIM {facts['ssim']:.4f}   picture {facts['picture']}")


@app.command("info", epilog="Example: phyradgs info scan.h5")
def info_command(file: Annotated[Path, typer.Argument(help="Scan or volume file.")]) -> None:
    """Say what a file holds."""
    for key, value in summary(file).items():
        typer.echo(f"{key.replace('_', ' '):24s} {value}")


@app.command("devices", epilog="Example: phyradgs devices --device cpu")
def devices_command(device: Device = None) -> None:
    """List OpenCL devices and say which one is taken, and why."""
    chosen, reason = choose_device(device)
    for d in list_devices():
        mark = "*" if d.index == chosen.index else " "
        never = "" if d.by_default else ", only when asked for"
        typer.echo(
            f"{mark} {d.index}: {d.name} ({d.kind}; {d.platform}), {d.compute_units} units, vector width {default_lanes(d)} "
            f"of {d.vector_width}, {d.memory_bytes / 2**30:.1f} GiB, at most {d.largest_allocation_bytes / 2**30:.1f} GiB "
            f"at once, float64 {'yes' if d.has_fp64 else 'no'}{never}"
        )
        typer.echo(f"     {d.version}")
    typer.echo(f"takes {chosen.index}: {reason}")


@app.callback(invoke_without_command=True)
def root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        typer.echo(f"phyradgs-cl {__version__}")
        raise typer.Exit


class Ticker:
    """Progress on stderr: one line rewritten on a terminal, a line every ten seconds elsewhere."""

    def __init__(self, noun: str) -> None:
        self.noun = noun
        self.is_terminal = sys.stderr.isatty()
        self.started = self.last = time.monotonic()
        self.first: int | None = None
        self.is_open = False

    def __enter__(self) -> Ticker:
        return self

    def __exit__(self, *_: object) -> None:
        if self.is_open:
            typer.echo("", err=True)

    def progress(self, p: Progress) -> None:
        self.show(p.iteration, p.iterations, f"  loss {p.loss:.5f}  {p.gaussians} Gaussians")

    def show(self, done: int, total: int, more: str = "") -> None:
        now = time.monotonic()
        if self.first is None:
            self.first, self.started = done, now
        if done < total and now - self.last < (0.2 if self.is_terminal else 10.0):
            return
        self.last = now
        rate = (done - self.first) / (now - self.started) if now > self.started and done > self.first else 0.0
        left = f"  {rate:.1f}/s  ETA {_clock((total - done) / rate)}" if rate else ""
        line = f"{self.noun} {done}/{total}{more}{left}"
        typer.echo(f"\r\x1b[K{line}" if self.is_terminal else line, err=True, nl=not self.is_terminal)
        self.is_open = self.is_terminal


def run(arguments: list[str]) -> int:
    """Runs one command; the exit status."""
    try:
        status = app(arguments, standalone_mode=False)
        return status if isinstance(status, int) else 0
    except PhyradgsError as error:
        typer.echo(f"phyradgs: {error}", err=True)
        return error.exit_code
    except MemoryError as error:
        text = " ".join(str(error).split())
        typer.echo(f"phyradgs: not enough memory: {text}; use a smaller problem", err=True)
        return 2
    except _CLICK_ERROR as error:
        text = " ".join(str(error.format_message()).split())  # type: ignore[attr-defined]
        typer.echo(f"phyradgs: {text or 'no command; see phyradgs --help'}", err=True)
        return 2
    except (KeyboardInterrupt, typer.Abort):
        typer.echo("phyradgs: interrupted, nothing written", err=True)
        return INTERRUPTED


def _read_config(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        with open(path, "rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise InputError(f"--config {path}", error.strerror or str(error), "a TOML file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"--config {path}", f"not TOML ({error})", "a TOML file") from error


def _seed(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError("seed", repr(value), "a whole number of at least 0")
    return value


def _pair(option: str, text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        v, u = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(option, repr(text), "two numbers V,U in mm", "write for example 0,12.5") from None
    return v, u


def _metrics_text(metrics: dict[str, float]) -> str:
    return f", PSNR {metrics['psnr_db']:.2f} dB, SSIM {metrics['ssim']:.4f}" if metrics else ""


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds + 0.5), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}" if minutes >= 60 else f"{minutes}:{rest:02d}"
