"""What surrounds a command: homes that cannot be written, variables of drivers, a standard error that is closed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import pocl

COMMAND = [sys.executable, "-m", "phyradgs_cl"]
POSIX = pytest.mark.skipif(os.name != "posix", reason="a shell and devices of POSIX")


def run(*words: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run([*COMMAND, *words], env=environment, capture_output=True, text=True, check=False)


@POSIX
def test_a_cache_that_cannot_be_written_costs_a_warning(tiny, tmp_path: Path) -> None:
    """PoCL's users are told of its cache."""
    usual = {name: value for name, value in os.environ.items() if name not in ("POCL_CACHE_DIR", "XDG_CACHE_HOME")}
    for where in ({"HOME": "/dev/null"}, {"POCL_CACHE_DIR": "/dev/null/cache"}):
        output = tmp_path / f"{next(iter(where))}.h5"
        done = run("simulate", *tiny, "-o", str(output), **usual | {"TMPDIR": str(tmp_path)} | where)
        told = [line for line in done.stderr.splitlines() if not line.startswith("frame ")]
        assert done.returncode == 0 and len(told) <= 1 and output.exists(), (where, done.stderr)
        for line in told:
            assert "cannot be written: kernels are kept in" in line and "set POCL_CACHE_DIR" in line


def test_a_number_of_threads_that_pocl_would_crash_on_is_refused(monkeypatch) -> None:
    monkeypatch.setenv(pocl.CACHE_VARIABLE, os.environ.get(pocl.CACHE_VARIABLE, ""))
    for wish in ("-1", "0", "abc", "1.5", "1e3", "1025", "99999999999999999999"):
        monkeypatch.setenv(pocl.THREADS_VARIABLE, wish)
        with pytest.raises(InputError, match=f"POCL_MAX_PTHREAD_COUNT: found '{wish}'; expected a whole number"):
            pocl.prepare_environment()
    for wish in ("", "1", "1024"):
        monkeypatch.setenv(pocl.THREADS_VARIABLE, wish)
        pocl.prepare_environment()
        assert os.environ[pocl.THREADS_VARIABLE] == wish
    done = run("devices", **os.environ | {pocl.THREADS_VARIABLE: "-1"})  # before the driver sees it
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("phyradgs: POCL_MAX_PTHREAD_COUNT: found '-1'") and done.stderr.count("\n") == 1


@POSIX
def test_without_standard_error_the_status_is_right() -> None:
    for words in ("info none.h5", "reconstruct --nonsense", "nonsense"):
        shell = ["sh", "-c", f'"$0" -m phyradgs_cl {words} 2>&-', sys.executable]
        done = subprocess.run(shell, capture_output=True, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (2, b"", b""), words
