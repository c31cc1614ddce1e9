"""The paper's tables: python benchmarks/tables table1 --volumes VOLUMES -o results"""

import sys
from pathlib import Path

import typer

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from phyradgs_cl.__main__ import load_cli  # noqa: E402
from tables.command import EXAMPLE, bench_command  # noqa: E402

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
app.command("tables", epilog=EXAMPLE)(bench_command)


def run(arguments: list[str]) -> int:
    """Runs the command. Errors are a line and a status, as for ``phyradgs``."""
    return load_cli().run(arguments, app)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
