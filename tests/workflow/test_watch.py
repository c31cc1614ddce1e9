"""A watched folder: every scan once, failures set aside, half-written files left alone, signals answered."""

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import pytest

from phyradgs_cl.errors import DeviceError, InputError, OutOfMemoryError, OutputError
from phyradgs_cl.io import only_run, read_volume
from phyradgs_cl.io.output import BusyError
from phyradgs_cl.reconstructors import plan_run
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.workflow import watch as watch_module
from phyradgs_cl.workflow.watch import Arrivals, WatchEvent, WatchJob, run_watch


@pytest.fixture
def job(tmp_path: Path) -> WatchJob:
    (tmp_path / "in").mkdir()
    return WatchJob(tmp_path / "in", tmp_path / "out", plan_run("fdk"), poll_s=0.01, settle_s=0.0, once=True)


@pytest.fixture
def drop(job: WatchJob, tiny_scan: Path):
    """A function that puts a whole scan into the watched folder."""

    def dropping(name: str) -> Path:
        part = job.folder / f".{name}.part"
        shutil.copy(tiny_scan, part)
        part.rename(job.folder / name)
        return job.folder / name

    return dropping


def watched(job: WatchJob, rt: Runtime) -> list[WatchEvent]:
    """Runs a watch until nothing is left, and returns its events."""
    told: list[WatchEvent] = []
    run_watch(job, lambda: rt, told.append)
    return told


def outputs(job: WatchJob) -> list[str]:
    return sorted(path.name for path in job.output.iterdir() if not path.name.startswith("."))


def test_every_scan_becomes_a_volume_once(job, drop, rt) -> None:
    drop("a.h5"), drop("b.h5")
    told = watched(job, rt)
    assert [event.scan.name for event in told] == ["a.h5", "b.h5"] and told[0].metrics["psnr_db"] > 5
    assert outputs(job) == ["a.h5", "b.h5"] and list((job.output / ".work").iterdir()) == []
    assert read_volume(job.output / "a.h5").provenance["scan"] == str(job.folder / "a.h5")
    drop("c.h5")
    assert [event.scan.name for event in watched(job, rt)] == ["c.h5"]
    assert watched(job, rt) == []


def test_a_failure_is_set_aside_until_its_file_changes(job, drop, rt) -> None:
    scan = drop("bad.h5")
    with h5py.File(scan, "r+") as file:
        del file["entry/instrument/detector/data"]
    drop("good.h5")
    told = {event.scan.name: event for event in watched(job, rt)}
    assert "data" in told["bad.h5"].error and told["good.h5"].result is not None
    assert outputs(job) == ["bad.error.txt", "good.h5"]
    assert (job.output / "bad.error.txt").read_text().startswith(told["bad.h5"].error)
    assert watched(job, rt) == []
    drop("bad.h5")  # written again, and whole
    (job.folder / "text.h5").write_text("no HDF5")
    assert ["not HDF5" in event.error for event in watched(job, rt)] == [False, True]
    assert watched(job, rt) == []
    (job.output / "text.error.txt").unlink()  # tried again
    assert "not HDF5" in watched(job, rt)[0].error
    assert outputs(job) == ["bad.h5", "good.h5", "text.error.txt"]


def test_a_file_that_another_program_has_open_for_writing_waits(job, drop, rt) -> None:
    scan = drop("open.h5")
    text = f"import h5py; f = h5py.File({str(scan)!r}, 'r+'); print('open', flush=True); input()"
    environment = {**os.environ, "HDF5_USE_FILE_LOCKING": "TRUE"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    writer = subprocess.Popen([sys.executable, "-c", text], env=environment, **pipes)
    try:
        assert writer.stdout.readline() == "open\n"
        assert watched(job, rt) == [] and outputs(job) == []
    finally:
        writer.communicate("\n")
    assert [event.error for event in watched(job, rt)] == [""]


def test_a_scan_that_changes_during_its_run_is_made_again(job, drop, rt, monkeypatch) -> None:
    scan = drop("a.h5")
    original, runs = watch_module.resume_or_restart, []

    def touching(*arguments):
        found = original(*arguments)
        runs.append(1)
        if len(runs) == 1:
            os.utime(scan, (1, 1))
        return found

    monkeypatch.setattr(watch_module, "resume_or_restart", touching)
    assert len(watched(job, rt)) == 1 and len(runs) == 2


def test_defects_and_too_little_memory_keep_no_other_scan_waiting(job, drop, rt, monkeypatch) -> None:
    errors = (ZeroDivisionError("a defect"), OutOfMemoryError("memory of it"), MemoryError())
    failures = dict(zip(("a.h5", "b.h5", "c.h5"), errors, strict=True))
    for name in (*failures, "d.h5"):
        drop(name)
    original = watch_module.resume_or_restart

    def failing(plan, scan, *rest):
        if scan.name in failures:
            raise failures[scan.name]
        return original(plan, scan, *rest)

    monkeypatch.setattr(watch_module, "resume_or_restart", failing)
    assert len(watched(job, rt)) == 4
    assert outputs(job) == ["a.error.txt", "b.error.txt", "c.error.txt", "d.h5"]


def test_devices_and_disks_that_fail_are_no_fault_of_a_scan(job, drop, rt, monkeypatch) -> None:
    """A lost device is opened again; one that is gone, or a full disk, ends the watch."""
    drop("a.h5")
    original, opened, told = watch_module.resume_or_restart, [], []

    def failing(error: Exception, times: int):
        def go_on(*arguments):
            if len(opened) < times:
                raise error
            return original(*arguments)

        return go_on

    def opening():
        opened.append(1)
        if len(opened) > 2:
            raise DeviceError("OpenCL", "no device")
        return rt

    monkeypatch.setattr(watch_module, "resume_or_restart", failing(DeviceError("device", "lost"), 2))
    run_watch(job, opening, told.append)
    assert len(told) == 1 and len(opened) == 2 and outputs(job) == ["a.h5"]
    drop("b.h5")
    full = OutputError("out", "no room")
    for error, end in ((DeviceError("device", "lost"), "no device"), (full, "no room")):
        opened[:] = [1]
        monkeypatch.setattr(watch_module, "resume_or_restart", failing(error, 9))
        with pytest.raises(type(error), match=end):
            run_watch(job, opening, told.append)
        assert outputs(job) == ["a.h5"]


def test_folders_and_locks_are_checked_first(job, rt, refused, tmp_path) -> None:
    with pytest.raises(InputError, match="no folder"):
        watched(replace(job, folder=tmp_path / "none"), rt)
    with pytest.raises(InputError, match="the watched folder itself"):
        watched(replace(job, output=job.folder), rt)
    job.output.mkdir()
    with only_run(job.output / "watch"), pytest.raises(BusyError, match="another run"):
        watched(job, rt)
    refused(["watch", job.folder, "-o", job.output, "--poll-s", "0"], "--poll-s")


def test_a_folder_that_is_away_for_a_while_is_waited_for(job, drop, rt, monkeypatch, caplog) -> None:
    drop("a.h5")
    original, looks = watch_module.Arrivals.look, []

    def away(self):
        looks.append(1)
        if len(looks) < 4:
            raise OSError(5, "Input/output error")
        return original(self)

    def stop(event: WatchEvent) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(watch_module.Arrivals, "look", away)
    with pytest.raises(KeyboardInterrupt):
        run_watch(replace(job, once=False), lambda: rt, stop)
    assert caplog.text.count("cannot be read") == 1 and outputs(job) == ["a.h5"]


def test_a_signal_keeps_a_checkpoint_that_the_next_start_goes_on_from(job, drop) -> None:
    drop("long.h5")
    command = [sys.executable, "-m", "phyradgs_cl", "watch", str(job.folder), "-o", str(job.output)]
    command += ["--method", "sirt", "--iterations", "1000000"]
    command += ["--poll-s", "0.05", "--checkpoint-every", "0.01"]
    checkpoint = job.output / ".work" / "long.h5.checkpoint.npz"

    def version() -> int:
        return checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0

    def started_until_a_new_checkpoint() -> subprocess.Popen:
        before, deadline = version(), time.monotonic() + 60
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        while version() == before and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        return process

    process = started_until_a_new_checkpoint()
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 143
    assert said.splitlines()[-1].startswith("phyradgs: interrupted: finished volumes are in")
    assert outputs(job) == [] and checkpoint.exists()
    assert [path.name for path in job.output.iterdir()] == [".work"]  # no lock is left
    again = started_until_a_new_checkpoint()
    again.kill()
    again.communicate()
    assert not list(checkpoint.parent.glob("*.bak"))  # it was gone on from, not set aside


# --- when a file is complete: it stood still long enough, or was renamed into place -----------------------------------


@pytest.fixture
def now() -> list[float]:
    return [0.0]


@pytest.fixture
def arrivals(tmp_path: Path, now: list[float]) -> Arrivals:
    return Arrivals(tmp_path, 5.0, lambda: now[0])


def names(arrivals: Arrivals) -> list[str]:
    return [arrival.path.name for arrival in arrivals.look()]


def test_a_file_that_is_written_waits_until_it_stands_still(arrivals, now, tmp_path) -> None:
    path = tmp_path / "scan.h5"
    for second in range(0, 20, 4):  # it grows
        with open(path, "ab") as file:
            file.write(b"x")
        now[0] = second
        assert names(arrivals) == []
    now[0] = 20.9
    assert names(arrivals) == []
    now[0] = 21.0
    assert names(arrivals) == ["scan.h5"]
    time.sleep(0.02)  # the clock of files ticks some hundred times per second
    path.write_bytes(b"y" * 5)  # of the same size
    assert names(arrivals) == []


def test_a_file_renamed_into_place_is_complete_at_once(arrivals, tmp_path) -> None:
    part = tmp_path / ".scan.h5.part"
    part.write_bytes(b"whole")
    assert names(arrivals) == []
    time.sleep(0.02)
    part.rename(tmp_path / "scan.h5")
    assert names(arrivals) == ["scan.h5"]
    (tmp_path / "copy.h5").write_bytes(b"whole")
    os.utime(tmp_path / "copy.h5", ns=(10**18, 10**18))  # a copy that keeps its times
    assert names(arrivals) == ["copy.h5", "scan.h5"]


def test_only_regular_files_with_the_suffix_are_scans_and_the_oldest_comes_first(arrivals, tmp_path) -> None:
    for age, name in enumerate(("b.h5", "a.h5", "notes.txt", ".hidden.h5", "c.h5.part")):
        (tmp_path / name).write_bytes(b"x")
        os.utime(tmp_path / name, (1000 + age, 1000 + age))
    (tmp_path / "folder.h5").mkdir()
    os.mkfifo(tmp_path / "pipe.h5")
    (tmp_path / "nowhere.h5").symlink_to(tmp_path / "none")
    (tmp_path / "empty.h5").touch()
    os.utime(tmp_path / "empty.h5", (1, 1))
    assert names(arrivals) == ["b.h5", "a.h5"]


def test_an_arrival_knows_whether_it_is_still_the_file(arrivals, tmp_path) -> None:
    path = tmp_path / "scan.h5"
    path.write_bytes(b"whole")
    os.utime(path, (1, 1))
    (arrival,) = arrivals.look()
    assert arrival.is_unchanged()
    os.utime(path, (2, 2))
    assert not arrival.is_unchanged()
    path.unlink()
    assert not arrival.is_unchanged()
