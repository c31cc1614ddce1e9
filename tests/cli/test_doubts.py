"""Warnings where they belong and nowhere else, files that are taken for others, and what surrounds a command."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from damage import changed, on

from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import device, pocl

pytestmark = pytest.mark.slow


@pytest.fixture
def warned(cli, scan, tmp_path, caplog):
    """What a reconstruction of a scan warns of."""

    def reconstruct(*options: str, scan: Path = scan) -> str:
        caplog.clear()
        assert cli.run(["reconstruct", str(scan), "-o", str(tmp_path / "v.h5"), *options]) == 0
        return caplog.text

    return reconstruct


def test_doubtful_options_are_said_and_others_not(warned) -> None:
    few = ["--method", "phyradgs", "--iterations", "1"]
    assert "no voxel of the first volume is above initial_threshold 5" in warned(*few, "--set", "initial_threshold=5")
    assert "13 strips are more than the 12 lines of " in warned(*few, "--strips", "13")
    assert warned(*few, "--strips", "12") == warned(*few) == warned("--method", "fdk") == ""


def test_doubtful_frames_are_said(cli, warned, scan, tiny, tmp_path) -> None:
    one, swapped = tmp_path / "one.h5", tmp_path / "swapped.h5"
    assert cli.run(["simulate", *tiny, "--views", "1", "-o", str(one)]) == 0
    assert "all views are from one angle" in warned("--method", "fdk", scan=one)
    swapped.write_bytes(scan.read_bytes())
    on("entry/instrument/detector/frame_start_time", changed(lambda times: np.sort(times)[[0, 2, 1, 3]]))(swapped)
    assert "frame 2 starts no later than frame 1" in warned("--method", "fdk", scan=swapped)


def test_no_device_for_want_of_a_cache_is_said(refused, monkeypatch) -> None:
    monkeypatch.setattr(pocl, "_unusable", (Path("/full/cache"), "written"))
    monkeypatch.setattr(device, "list_devices", list)
    refused(["devices"], "/full/cache cannot be written", "set POCL_CACHE_DIR to a folder that can", status=5)


POSIX = pytest.mark.skipif(os.name != "posix", reason="a shell and devices of POSIX")


def run(*words: str, **environment: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "phyradgs_cl", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@POSIX
def test_a_cache_that_cannot_be_written_costs_a_warning(tiny, tmp_path: Path) -> None:
    """PoCL's users are told of its cache."""
    usual = {name: os.environ[name] for name in os.environ.keys() - {"POCL_CACHE_DIR", "XDG_CACHE_HOME"}}
    output = tmp_path / "scan.h5"
    simulate = ["simulate", *tiny, "-o", str(output)]
    for where, words in (({"HOME": "/dev/null"}, ["devices"]), ({"POCL_CACHE_DIR": "/dev/null/cache"}, simulate)):
        done = run(*words, **usual | {"TMPDIR": str(tmp_path)} | where)
        told = [line for line in done.stderr.splitlines() if not line.startswith("frame ")]
        assert done.returncode == 0 and len(told) <= 1 and output.exists() == ("simulate" in words), (where, done.stderr)
        for line in told:
            assert "cannot be written: kernels are kept in" in line and "set POCL_CACHE_DIR" in line


def test_a_number_of_threads_that_pocl_would_crash_on_is_refused(monkeypatch) -> None:
    monkeypatch.setenv(pocl.CACHE_VARIABLE, os.environ.get(pocl.CACHE_VARIABLE, ""))
    for wish in ("0", "abc", "1025"):
        monkeypatch.setenv(pocl.THREADS_VARIABLE, wish)
        with pytest.raises(InputError, match=f"POCL_MAX_PTHREAD_COUNT: found '{wish}'; expected a whole"):
            pocl.prepare_environment()
    for wish in ("", "1024"):
        monkeypatch.setenv(pocl.THREADS_VARIABLE, wish)
        pocl.prepare_environment()
        assert os.environ[pocl.THREADS_VARIABLE] == wish
    done = run("devices", **os.environ | {pocl.THREADS_VARIABLE: "-1"})  # before the driver sees it
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("phyradgs: POCL_MAX_PTHREAD_COUNT: found '-1'")


@POSIX
def test_a_reader_that_goes_away_is_no_error_and_without_standard_error_the_status_is_right(scan) -> None:
    for words in (["info", str(scan)], ["--help"]):
        command = [sys.executable, "-m", "phyradgs_cl", *words]
        started = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.stdout.close()
        assert started.stderr.read() == "" and started.wait(60) == 0
    shell = ["sh", "-c", '"$0" -m phyradgs_cl info none.h5 2>&-', sys.executable]
    done = subprocess.run(shell, capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (2, b"", b"")
