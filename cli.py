"""The command line ``phyradgs`` with all commands. An error prints one line on stderr; its kind decides the exit status."""

import importlib
from collections import UserDict
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from phyradgs_cl import __version__, signals
from phyradgs_cl.commands.console import GroupedCommand, complain, give_up_stdout, say, takes_part, usage_text
from phyradgs_cl.errors import OutputError, PhyradgsError, naming_host_memory
from phyradgs_cl.io.output import NO_SPACE
from phyradgs_cl.removed import refuse_removed

_CLICK_ERROR: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")
HELP = {"help_option_names": ["-h", "--help"]}
# For each command NAME: the module in commands/ that defines the function NAME_command, and NAME's line in the help.
COMMANDS = {
    "simulate": ("simulate", "Simulate a fly-scan of a phantom or a volume."),
    "import": ("import_scan", "Turn the scan of another program into a scan file."),
    "check": ("check", "Look for problems of a scan."),
    "calibrate": ("calibrate", "Estimate a scan's true geometry and timing from its frames."),
    "prepare": ("prepare", "Correct the effects of panel and beam in a scan."),
    "reconstruct": ("reconstruct", "Reconstruct a scan into a volume."),
    "estimate": ("reconstruct", "Estimate the time and memory of a reconstruction."),
    "evaluate": ("evaluate", "Measure a volume against the truth."),
    "report": ("report", "Write one HTML page about a reconstruction."),
    "view": ("report", "Look at a volume in napari."),
    "export": ("files", "Write a volume for 3D Slicer, ImageJ, napari and others."),
    "sweep": ("sweep", "Reconstruct many scans with many settings."),
    "info": ("files", "Print the contents of a scan or volume file."),
    "devices": ("devices", "List OpenCL devices, and the one that is used."),
}


class Interrupted(Exception):
    """Replaces the KeyboardInterrupt of Ctrl-C, at which Typer would end the program without a message."""


class Loaded(UserDict[str, Any]):
    """Maps a name of ``COMMANDS`` to its Typer command. Imports the command's module only at look-up, which saves time."""

    def __getitem__(self, name: str) -> Any:
        module_name, summary = COMMANDS[name]
        module = importlib.import_module(f"phyradgs_cl.commands.{module_name}")
        alone = typer.Typer(add_completion=False, rich_markup_mode=None, context_settings=HELP)
        function = getattr(module, f"{name}_command")
        alone.command(name, cls=GroupedCommand, short_help=summary, epilog=module.EXAMPLES[name])(function)
        command: Any = typer.main.get_command(alone)
        command.groups = getattr(module, "GROUPS", {}).get(name, {})
        return command


class Commands(TyperGroup):
    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = Loaded(COMMANDS)

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, name: str) -> Any:
        refuse_removed(f"phyradgs {name}")
        return super().get_command(ctx, name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])

    def invoke(self, ctx: Any) -> object:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise Interrupted from None


app = typer.Typer(
    name="phyradgs",
    cls=Commands,
    add_completion=True,
    rich_markup_mode=None,
    context_settings=HELP,
    pretty_exceptions_enable=False,
    help="Fly-scanning cone-beam CT: simulate scans, reconstruct them with known motion, measure the result. "
    "'phyradgs COMMAND --help' explains a command.\n\n"
    "Exit status: 0 done, 2 wrong input, 3 numbers that overflowed, 4 output not written, 5 no device or a failing one, "
    "6 out of memory, 10 suspicious (check), 130 interrupted, 143 terminated.",
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


def run(arguments: list[str], program: typer.Typer = app) -> int:
    """Runs ``program`` with the words ``arguments`` and returns the exit status. Prints expected errors, raises others."""
    if not takes_part(arguments):
        return 0
    with signals.answer_signals():
        try:
            with naming_host_memory():
                status = program(arguments, standalone_mode=False)
            return status if isinstance(status, int) else 0
        except PhyradgsError as error:
            return complain(str(error), error.exit_code)
        except _CLICK_ERROR as error:
            return complain(usage_text(error, arguments))
        except OSError as error:  # an error of the operating system that no code turned into a PhyradgsError
            text = f"{error.filename or 'operating system'}: {error.strerror or error}"
            return complain(text, OutputError.exit_code if error.errno in NO_SPACE else 2)
        except SystemExit:  # Typer raises SystemExit if the program that reads its help closes the pipe, as `| head` does
            give_up_stdout()
            return 0
        except (Interrupted, KeyboardInterrupt, typer.Abort):
            return complain(signals.farewell(), signals.exit_status())
