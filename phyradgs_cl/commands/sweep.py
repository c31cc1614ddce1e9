"""The command sweep: reconstructs many scans with many settings and seeds."""

from pathlib import Path
from typing import Annotated, Any

import typer

from phyradgs_cl import signals
from phyradgs_cl.commands.console import complain, file_argument, option, say, scores
from phyradgs_cl.commands.options import CHECKPOINT_EVERY_S, CheckpointEvery
from phyradgs_cl.progress import Ticker
from phyradgs_cl.settings import device_wish
from phyradgs_cl.workflow.sweep import RESULTS, TABLE, plan_sweep, run_sweep

_REPEAT = "The command makes only the runs that its results file lacks: interrupt and repeat it at will."
EXAMPLES = {"sweep": f"Example: phyradgs sweep grid.toml -o results --workers 2\n\n{_REPEAT} Docs: cluster.md."}
GROUPS = {"sweep": {"Basics": ("output", "checkpoint_every"), "Workers": ("workers", "device")}}
_WORKERS = "Dask's workers that make the runs: so many processes here, or those of a scheduler."
_DEVICES = "Devices of the workers, with commas: indices, cpu, gpu or parts of names; each takes the next."


def sweep_command(
    grid: Annotated[Path, file_argument("GRID", "TOML file: scans, settings and seeds (docs: cluster.md).")],
    output: Annotated[Path, option("Folder of lines, volumes and a table.", True, "--output", "-o", metavar="DIR")],
    workers: Annotated[str | None, option(_WORKERS, "none, one run at a time", metavar="N|ADDRESS")] = None,
    checkpoint_every: CheckpointEvery = CHECKPOINT_EVERY_S,
    device: Annotated[
        str | None, option(_DEVICES, "the best one, and others of its name", parser=device_wish, metavar="TEXT")
    ] = None,
) -> None:
    """Reconstruct many scans with many settings: a results file, volumes, and a table."""
    runs = plan_sweep(grid, output, checkpoint_every)
    with Ticker("iteration") as ticker:

        def tell(done: int, line: dict[str, Any]) -> None:
            ticker.end_line()
            ticker.first = None  # so that the ticker measures the next run's rate from that run's start
            outcome = f"failed: {line['error']}" if "error" in line else f"{line['seconds']:.1f} s{scores(line['metrics'])}"
            say(f"{done}/{len(runs)} {line['run']} ({line['label']}): {outcome}")

        try:
            failed = run_sweep(runs, output, workers, device, tell=tell, report=ticker.progress)
        except KeyboardInterrupt:
            ticker.end_line()
            complain(f"interrupted: finished runs are in {output / RESULTS}; repeat the command to continue")
            raise typer.Exit(signals.exit_status()) from None
    say(f"{output / RESULTS}\n{output / TABLE}")
    if failed:
        complain(f"{failed} runs failed: {output / TABLE} gives the reasons; repeat the command to try again")
        raise typer.Exit(2)
