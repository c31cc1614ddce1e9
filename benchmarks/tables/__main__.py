"""The paper's tables: python benchmarks/tables table1 --volumes VOLUMES -o results"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from phyradgs_cl.__main__ import load_cli  # noqa: E402
from tables.command import compare_methods, parser  # noqa: E402


def run(arguments: list[str]) -> int:
    """Runs the command. Errors are a line and a status, as for ``phyradgs``."""
    asked = parser().parse_args(arguments)
    return load_cli().run(arguments, lambda *_, **__: compare_methods(asked))


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
