"""Processes that tests start and end, and waiting for their effects."""

import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress


def stop(process: subprocess.Popen) -> None:
    """SIGKILL to a process and to all that it has started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_until(is_so: Callable[[], bool], seconds: float, what: Callable[[], str]) -> None:
    deadline = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < deadline, what()
        time.sleep(0.02)
