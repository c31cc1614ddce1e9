"""Entry point of the command ``phyradgs``: loads cli.py, which is inside the package or next to it, and runs it."""

import importlib.util
import signal
import sys
from types import ModuleType

from phyradgs_cl import resource


def load_cli() -> ModuleType:
    """Loads cli.py and returns the module. Raises ImportError or FileNotFoundError if the installation lacks cli.py."""
    spec = importlib.util.spec_from_file_location("phyradgs_cl_cli", resource("cli.py"))
    if spec is None or spec.loader is None:
        raise ImportError("cli.py cannot be loaded: install phyradgs-cl again")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Runs the command line and exits with its status. Ctrl-C prints one line instead of a traceback; the status is 130."""
    try:
        status = load_cli().run(sys.argv[1:])
    except KeyboardInterrupt:  # Ctrl-C while libraries load; later cli.py itself handles Ctrl-C
        sys.stderr.write("phyradgs: interrupted, nothing new written\n")
        status = 130
    for number in (signal.SIGINT, signal.SIGTERM):  # ignored: at the interpreter's end one would print a traceback
        signal.signal(number, signal.SIG_IGN)
    sys.exit(status)


if __name__ == "__main__":
    main()
