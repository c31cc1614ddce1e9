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
TINY = ["--phantom", "jaw", "--size", "8", "--detector", "12", "--views", "4", "--time-samples", "2"]


def test_a_home_that_is_no_folder_costs_a_warning(tmp_path: Path) -> None:
    homeless = {name: value for name, value in os.environ.items() if name != "POCL_CACHE_DIR"}
    done = subprocess.run(
        [*COMMAND, "simulate", *TINY, "-o", str(tmp_path / "scan.h5")],
        env=homeless | {"HOME": "/dev/null", "XDG_CACHE_HOME": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    told = [line for line in done.stderr.splitlines() if not line.startswith("frame ")]
    assert done.returncode == 0 and len(told) <= 1, done.stderr  # PoCL's users are told of its cache
    assert all("cannot be written" in line for line in told)
    assert (tmp_path / "scan.h5").exists()


@pytest.mark.parametrize("wish", ["-1", "0", "abc", "1.5", "1e3", "1025", "99999999999999999999"])
def test_a_number_of_threads_that_pocl_would_crash_on_is_refused(monkeypatch, wish) -> None:
    monkeypatch.setenv(pocl.THREADS_VARIABLE, wish)
    with pytest.raises(InputError, match=f"POCL_MAX_PTHREAD_COUNT: found '{wish}'; expected a whole number"):
        pocl.prepare_environment()


@pytest.mark.parametrize("wish", ["", "1", "1024"])
def test_a_number_of_threads_that_there_can_be_is_taken(monkeypatch, wish) -> None:
    monkeypatch.setenv(pocl.CACHE_VARIABLE, os.environ.get(pocl.CACHE_VARIABLE, ""))
    monkeypatch.setenv(pocl.THREADS_VARIABLE, wish)
    pocl.prepare_environment()
    assert os.environ[pocl.THREADS_VARIABLE] == wish


def test_a_command_refuses_the_number_before_the_driver_sees_it() -> None:
    done = subprocess.run(
        [*COMMAND, "devices"],
        env=os.environ | {pocl.THREADS_VARIABLE: "-1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("phyradgs: POCL_MAX_PTHREAD_COUNT: found '-1'") and done.stderr.count("\n") == 1


@pytest.mark.parametrize("words", ["info none.h5", "reconstruct --nonsense", "nonsense"])
@pytest.mark.skipif(os.name != "posix", reason="closes a descriptor in a shell of POSIX")
def test_without_standard_error_the_status_is_right(words) -> None:
    done = subprocess.run(
        ["sh", "-c", f'"$0" -m phyradgs_cl {words} 2>&-', sys.executable], capture_output=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (2, b"", b"")
