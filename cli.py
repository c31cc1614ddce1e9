"""The command line: the commands put together. Every error is one line on stderr and an exit status of its kind."""

from __future__ import annotations

from typing import Annotated

import typer
from typer.core import TyperGroup

from phyradgs_cl import __version__, signals
from phyradgs_cl.commands import (
    bench,
    check,
    devices,
    estimate,
    evaluate,
    export_volume,
    import_scan,
    info,
    reconstruct,
    report,
    simulate,
    sweep,
    view,
    watch,
)
from phyradgs_cl.commands.console import complain, give_up_stdout, say, usage_text
from phyradgs_cl.commands.help_panels import PanelledCommand
from phyradgs_cl.commands.ranks import takes_part
from phyradgs_cl.errors import OutputError, PhyradgsError, naming_host_memory
from phyradgs_cl.io.atomic import NO_SPACE
from phyradgs_cl.reconstructors.interrupt import InterruptedAfterwards

_CLICK_ERROR: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


class Interrupted(Exception):
    """Ctrl-C on its way past Typer, with what is to be said about it."""


class Commands(TyperGroup):
    """The commands. Typer would end Ctrl-C without a word; here it is handed on under another name."""

    def invoke(self, ctx: typer.Context) -> object:
        try:
            return super().invoke(ctx)
        except InterruptedAfterwards:
            raise Interrupted(signals.COMPLETE) from None
        except KeyboardInterrupt:
            raise Interrupted(signals.farewell) from None


app = typer.Typer(
    name="phyradgs",
    cls=Commands,
    add_completion=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    help="Fly-scanning cone-beam CT: simulate scans, reconstruct them with motion known, measure the result. "
    "'phyradgs COMMAND --help' explains a command.\n\n"
    "Exit status: 0 done, 2 wrong input, 3 numbers that overflowed, 4 output not written, 5 no device or one that fails, "
    "6 out of memory, 10 suspicious (check), 130 interrupted, 143 terminated.",
)
app.command("simulate", short_help="Simulate a fly-scan of a phantom or a volume.", epilog=simulate.EXAMPLE)(
    simulate.simulate_command
)
app.command(
    "import", short_help="Turn the scan of another program into a scan file.", epilog=import_scan.EXAMPLE
)(import_scan.import_command)
app.command("check", short_help="Look for what is wrong or suspicious in a scan.", epilog=check.EXAMPLE)(
    check.check_command
)
app.command(
    "reconstruct",
    cls=PanelledCommand,
    short_help="Reconstruct a scan into a volume.",
    epilog=reconstruct.EXAMPLE,
)(reconstruct.reconstruct_command)
app.command(
    "estimate",
    cls=PanelledCommand,
    short_help="Say what time and memory a reconstruction would take.",
    epilog=estimate.EXAMPLE,
)(estimate.estimate_command)
app.command("evaluate", short_help="Measure a volume against the truth.", epilog=evaluate.EXAMPLE)(
    evaluate.evaluate_command
)
app.command("report", short_help="Write one HTML page about a reconstruction.", epilog=report.EXAMPLE)(
    report.report_command
)
app.command("view", short_help="Look at a volume in napari.", epilog=view.EXAMPLE)(view.view_command)
app.command(
    "export",
    short_help="Write a volume for 3D Slicer, ImageJ, napari and others.",
    epilog=export_volume.EXAMPLE,
)(export_volume.export_command)
app.command("bench", short_help="Compare methods on volumes.", epilog=bench.EXAMPLE)(bench.bench_command)
app.command("sweep", short_help="Reconstruct many scans with many settings.", epilog=sweep.EXAMPLE)(
    sweep.sweep_command
)
app.command("watch", short_help="Reconstruct the scans of a folder as they arrive.", epilog=watch.EXAMPLE)(
    watch.watch_command
)
app.command("info", short_help="Say what a scan or volume file holds.", epilog=info.EXAMPLE)(
    info.info_command
)
app.command("devices", short_help="List OpenCL devices, and say which one is taken.", epilog=devices.EXAMPLE)(
    devices.devices_command
)


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
    signals.start_afresh()
    if not takes_part(arguments):
        return 0
    try:
        with naming_host_memory():
            status = app(arguments, standalone_mode=False)
        return status if isinstance(status, int) else 0
    except PhyradgsError as error:
        return complain(str(error), error.exit_code)
    except _CLICK_ERROR as error:
        return complain(usage_text(error, arguments))
    except OSError as error:  # one that no reader or writer has named
        text = f"{error.filename or 'operating system'}: {error.strerror or error}"
        return complain(text, OutputError.exit_code if error.errno in NO_SPACE else 2)
    except SystemExit:  # Typer's answer to a reader of its help that has gone away, as in `| head`
        give_up_stdout()
        return 0
    except Interrupted as interrupted:
        return complain(str(interrupted), signals.status())
    except (KeyboardInterrupt, typer.Abort):
        return complain(signals.farewell, signals.status())
