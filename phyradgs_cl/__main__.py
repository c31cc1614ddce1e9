"""Entry point: answers signals, loads the command line (cli.py, inside the package or beside it) and runs it."""

import sys

from phyradgs_cl import signals

if __name__ == "__main__":
    signals.take_over()  # before anything that takes time

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import ModuleType


def load_cli() -> "ModuleType":
    """The module cli.py, wherever this installation keeps it."""
    import importlib.util

    from phyradgs_cl.resources import resource

    spec = importlib.util.spec_from_file_location("phyradgs_cl_cli", resource("cli.py"))
    if spec is None or spec.loader is None:
        raise ImportError("cli.py cannot be loaded: install phyradgs-cl again")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Runs the command line and exits with its status; Ctrl-C gives one line and status 130 at any time."""
    signals.take_over()
    status = load_cli().run(sys.argv[1:])
    signals.let_go()
    sys.exit(status)


if __name__ == "__main__":
    main()
