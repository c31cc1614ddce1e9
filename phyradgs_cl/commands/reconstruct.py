"""The commands reconstruct, which makes a volume file from a scan file, and estimate, which predicts its time and memory."""

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from phyradgs_cl import report, signals
from phyradgs_cl.acquisition.motion import motion_facts
from phyradgs_cl.acquisition.plausible import blur_line
from phyradgs_cl.commands import options
from phyradgs_cl.commands.console import complain, file_option, last_words, option, say, scores
from phyradgs_cl.commands.options import CheckpointEvery, ObjectMotion, Output, Scan, with_run_options
from phyradgs_cl.estimate import duration, estimate, seconds_around
from phyradgs_cl.io import only_run, partial_path, refuse_overwriting
from phyradgs_cl.parallel import failing_together, launched_ranks
from phyradgs_cl.progress import Ticker
from phyradgs_cl.reconstructors import Progress, ProgressReport, Reconstruction
from phyradgs_cl.reconstructors.moving import motion_line
from phyradgs_cl.reconstructors.result import COMPARED, DOUBT, MOTION_FOUND, option_facts
from phyradgs_cl.runtime import Runtime, profile_text
from phyradgs_cl.settings import Settings
from phyradgs_cl.workflow import load_scan, run_reconstruction
from phyradgs_cl.workflow.files import check_picture
from phyradgs_cl.workflow.slabs import Slabs, rows_of

EXAMPLES = {
    "reconstruct": (
        "Example: phyradgs reconstruct scan.h5 -o volume.h5 --method phyradgs --iterations 2000\n\n"
        "Ctrl-C keeps the volume so far, here as volume.partial.h5, and a checkpoint for --resume; of fdk and fbp nothing."
    ),
    "estimate": "Example: phyradgs estimate scan.h5 --method fista-tv --motion per-row",
}
_GROUPS = {
    "Basics": ("output", "method", "motion", "size", "iterations"),
    "Volume": (*(name for name in options.OF_GRID if name != "size"), "initial", "mu_water_per_mm", "rows", "slab"),
    "Motion": ("object_motion", *options.OF_MOTION, "detector_model"),
    "Quality": (
        *options.OF_METHODS, "preset", "assignments", *(name for name in options.OF_FRAMES if name not in options.OF_GRID),
        "seed",
    ),
    "Run": ("device", "memory", "config", "preview", "live", "resume", "checkpoint_every", "profile"),
}
GROUPS = {"reconstruct": _GROUPS, "estimate": _GROUPS}  # each command's help shows only options that it has
_ROWS = "Detector rows of a parallel scan to read and reconstruct; row 0 is the lowest."
_SLAB = "Rows of a parallel scan at a time: slabs, kept on disk as they are done."
_WATER = "Attenuation of water in 1/mm, for --initial in Hounsfield units that does not state its scale."
_LIVE = "HTML page of the run, written again every five seconds; after the run it is the report."
_PREVIEW = "PNG of the three middle slices; during the run NAME.partial.png, every five seconds."


@with_run_options()
@signals.keep_finished_work()  # Ctrl-C in the last iteration leaves a complete run, whose results are printed as usual
def reconstruct_command(
    scan: Scan, output: Output, settings: Settings,
    initial: Annotated[Path | None, file_option("Volume to start from.", "--initial")] = None,
    mu_water_per_mm: Annotated[float | None, option(_WATER, "the file's")] = None,
    object_motion: ObjectMotion = None,
    resume: Annotated[bool, option("Continue an interrupted run from its checkpoint.", True, "--resume")] = False,
    checkpoint_every: CheckpointEvery = options.CHECKPOINT_EVERY_S,
    preview: Annotated[Path | None, file_option(_PREVIEW, "--preview")] = None,
    live: Annotated[Path | None, file_option(_LIVE, "--live")] = None,
    profile: Annotated[bool, option("Print the device's time by kernel.", True, "--profile")] = False,
    rows: Annotated[str | None, option(_ROWS, "all", metavar="A:B")] = None,
    slab: Annotated[int, option(_SLAB, "as memory allows", metavar="ROWS", min=0)] = 0,
) -> None:
    """Reconstruct a scan into a volume; print PSNR and SSIM if the scan carries the truth. Defaults are those of fista."""
    plan, ranks = settings.plan(initial, object_motion, mu_water_per_mm), launched_ranks()
    ticker, runtimes = Ticker("iteration"), list[Runtime]()

    def stage(text: str) -> None:
        ticker.stage(text)
        if page is not None:
            page.stage(text)

    def runtime() -> Runtime:
        runtimes.append(settings.runtime(profile=profile, ranks=ranks))
        stage("building kernels")
        return runtimes[-1]

    def told(progress: Progress) -> None:
        for listener in listeners:
            listener(progress)

    inputs = [path for path in (settings.config, initial, object_motion) if path is not None]
    files = scan, output, partial_path(output), *inputs
    listeners: list[ProgressReport] = [ticker.progress]
    with failing_together(ranks, last_words), ticker, ExitStack() as stack:
        page = None
        if live is not None:
            check_picture("--live", live, *files, suffixes=(".html", ".htm"))
            if ranks.rank == 0:
                shown = {"scan": str(scan), "method": plan.method_name, "seed": plan.seed}
                shown |= {"input": plan.preprocessing.facts(), "options": option_facts(plan.options)}
                stack.enter_context(only_run(live))
                page = stack.enter_context(report.LivePage(live, output.name, shown))
                listeners.append(page)
        stage(f"reading {scan}")
        picture = None
        if preview is not None:
            check_picture("--preview", preview, *files)
            refuse_overwriting("--preview", partial_path(preview), *files)
            if ranks.rank == 0:
                stack.enter_context(only_run(preview))
            picture = report.Preview(preview)
            listeners.append(picture)
        result, metrics = run_reconstruction(
            plan, scan, output, runtime, told, resume=resume,
            checkpoint_every_s=checkpoint_every, inputs=inputs, ranks=ranks,
            slabs=Slabs(None if rows is None else rows_of(rows), slab),
        )
        if picture is not None and result.state is None and ranks.rank == 0:
            with signals.finish_despite_interrupt():
                picture.finish(result.volume, result.grid)
        if page is not None:
            _finish(page, result, scan, output, runtimes[-1])
    written = output if result.state is None else partial_path(output)
    used_s = time.process_time()  # the command's processor time, which other programs do not change
    motion = getattr(plan.options, "motion", None)
    method = plan.method_name if motion is None else f"{plan.method_name}, motion {motion_facts(motion)['name']}"
    how = f"{method}{result.early_stop}, {result.facts['seconds']:.1f} s ({used_s:.1f} s of processor time)"
    compared = f" ({result.facts[COMPARED]})" if COMPARED in result.facts else ""
    say(f"{written}: {how}{scores(metrics)}{compared}")
    if plan.initial is not None and "initial_converted" in plan.initial.facts:
        say(f"first volume: {plan.initial.facts['initial_converted']}")
    if MOTION_FOUND in result.facts and result.state is None:
        say(motion_line(result.facts[MOTION_FOUND]))
    if result.states is not None and result.state is None:
        times_s = result.states.times_s
        say(f"states of the object: {len(times_s)}, {times_s[0]:.4g} to {times_s[-1]:.4g} s; the volume is their mean")
    if result.doubt is not None:
        of_bars = result.facts[DOUBT]
        mean = f"mean σ, weighted by density, {of_bars['mean_per_mm']:.3g} 1/mm"
        say(f"error bars: {mean}, the 95 % bar is {of_bars['multiple_95']:.3g} σ")
    if profile:
        say(profile_text(runtimes[-1].kernel_uses(), float(result.facts["seconds"])))
    if result.state is not None:
        complain(f"interrupted at {result.interrupted_at}: repeat the command with --resume to continue")
        raise typer.Exit(signals.exit_status())


def _finish(page: "report.LivePage", result: Reconstruction, scan: Path, output: Path, rt: Runtime) -> None:
    """Turns the live page of a complete run into the run's report. The page of an interrupted run says how to continue. The
    page of a run in slabs names the command that makes a report, because all its frames may not fit in memory."""
    if result.state is not None:
        page.end(f"Interrupted at {result.interrupted_at}: repeat the command with --resume to continue.")
    elif "slabs" in result.facts:
        page.end("The run is complete. 'phyradgs report' makes its report.", is_complete=True)
    else:
        with signals.finish_despite_interrupt():
            page.become(lambda path: report.write_report(output, path, lambda: rt, scan=scan))


@with_run_options("seed")
def estimate_command(scan: Scan, settings: Settings, object_motion: ObjectMotion = None) -> None:
    """Estimate the time and memory of a reconstruction, from a few iterations of it."""
    plan = settings.plan(object_motion=object_motion)
    loaded = load_scan(scan, plan.preprocessing.flats)
    rt = settings.runtime()
    before_s = time.process_time()  # the time to start and to read the scan, which a run will need too
    values = estimate(loaded, plan, rt, lambda result: before_s + seconds_around(scan, loaded, result))
    say(f"{plan.method_name} on {rt.device.name}, from a trial of {duration(values.trial_seconds)}")
    say("\n".join(filter(None, (values.text(), blur_line(loaded)))))
