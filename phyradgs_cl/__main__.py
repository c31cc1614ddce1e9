"""Entry point: loads the command line (cli.py, inside the package or beside it) and runs it."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
from types import FrameType, ModuleType

from phyradgs_cl.resources import resource

INTERRUPTED = 130


def load_cli() -> ModuleType:
    """The module cli.py, wherever this installation keeps it."""
    spec = importlib.util.spec_from_file_location("phyradgs_cl_cli", resource("cli.py"))
    if spec is None or spec.loader is None:
        raise ImportError("cli.py cannot be loaded: install phyradgs-cl again")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Runs the command line and exits with its status; Ctrl-C gives one line and status 130 at any time."""
    is_ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # else somebody wants it ignored
    if is_ours:
        signal.signal(signal.SIGINT, _stop_at_once)
    cli = load_cli()
    try:
        if is_ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        status = cli.run(sys.argv[1:])
        if is_ours:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # nothing is left to be interrupted
    except KeyboardInterrupt:  # a second one, while the first was being reported
        status = INTERRUPTED
    sys.exit(status)


def _stop_at_once(number: int, frame: FrameType | None) -> None:
    """While libraries load there is nothing to clean up, and an exception could end inside any of them."""
    os.write(2, b"phyradgs: interrupted, nothing written\n")
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    main()
