"""Under real MPI: `make test-mpi`. The same volumes on 1, 3 and 4 ranks, and one end for all, whoever dies."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from parallel.shared_runs import small_scan
from tolerances import RANK_VOLUME

from phyradgs_cl.io import partial_path, read_volume, write_scan

BESIDE = Path(sys.executable).with_name("mpiexec")
MPIEXEC = str(BESIDE) if BESIDE.exists() else str(shutil.which("mpiexec"))
WORK = Path(__file__).with_name("mpi_work.py")
PHYRADGS = [sys.executable, "-m", "phyradgs_cl"]
# ranks of a test share the processors of one machine
QUIET = {**os.environ, "POCL_MAX_PTHREAD_COUNT": "1"}


@pytest.fixture(scope="module")
def scan_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mpi") / "scan.h5"
    write_scan(path, small_scan())
    return path


Made = Callable[[int], dict[str, np.ndarray]]


@pytest.fixture(scope="module")
def made(scan_file: Path) -> Made:
    """What ``mpi_work.py`` makes on so many ranks; each number is run once."""

    @cache
    def on(size: int) -> dict[str, np.ndarray]:
        out = scan_file.with_name(f"on{size}.npz")
        done = run([MPIEXEC, "-n", str(size), sys.executable, "-m", "mpi4py", str(WORK), str(scan_file), str(out)])
        assert done.returncode == 0, done.stdout + done.stderr
        with np.load(out) as arrays:
            return dict(arrays)

    return on


@pytest.mark.parametrize("size", [3, 4])
def test_the_same_volume_on_1_3_and_4_ranks(made: Made, size: int) -> None:
    one, several = made(1), made(size)
    assert int(several["size"]) == size
    for name in ("micro-views", "exact", "gradient"):
        np.testing.assert_array_equal(several[name], one[name])
    for name in ("sirt", "os-sart", "fista-tv", "asd-pocs"):
        assert np.linalg.norm(several[name] - one[name]) <= RANK_VOLUME * np.linalg.norm(one[name])


# --- the command line -------------------------------------------------------------------------------


def command(size: int, scan: Path, output: Path, *more: str) -> list[str]:
    options = ["--method", "phyradgs", "--iterations", "400", "--set", "batch=4", "--gaussians", "300"]
    options += ["--checkpoint-every", "0.05"]
    return [MPIEXEC, "-n", str(size), *PHYRADGS, "reconstruct", str(scan), "-o", str(output), *options, *more]


def run(words: Sequence[str]) -> subprocess.CompletedProcess:
    return subprocess.run(words, env=QUIET, capture_output=True, text=True, timeout=300)


def said(stderr: str) -> list[str]:
    """Lines of ours: without those of a counter, and of mpiexec."""
    lines = stderr.replace("\r", "\n").splitlines()
    return [line for line in lines if line.startswith("phyradgs:") or "Traceback" in line]


def descendants(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            found += [int(child), *descendants(int(child))]
    return found


def ranks_of(launcher: subprocess.Popen) -> dict[int, int]:
    """Process ids by rank."""
    found = {}
    for pid in descendants(launcher.pid):
        words = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
        given = dict(word.split(b"=", 1) for word in words if b"=" in word)
        if b"PMI_RANK" in given and b"reconstruct" in Path(f"/proc/{pid}/cmdline").read_bytes():
            found[int(given[b"PMI_RANK"])] = pid
    return found


def stop_midway(words: Sequence[str], output: Path, act: Callable[[subprocess.Popen], None]) -> tuple[int, str]:
    """Runs until there is a checkpoint, then acts; (exit status, standard error) when no rank is left."""
    checkpoint = output.with_name(f"{output.name}.checkpoint.npz")
    with open(output.with_suffix(".log"), "w+") as log:
        process = subprocess.Popen(words, env=QUIET, stdout=subprocess.DEVNULL, stderr=log, start_new_session=True)
        try:
            deadline = time.monotonic() + 120
            while not checkpoint.exists():
                assert process.poll() is None and time.monotonic() < deadline, log.name
                time.sleep(0.01)
            pids = ranks_of(process).values()
            act(process)
            status = process.wait(60)
            deadline = time.monotonic() + 10
            while any(Path(f"/proc/{pid}").exists() for pid in pids) and time.monotonic() < deadline:
                time.sleep(0.01)
            assert not [pid for pid in pids if Path(f"/proc/{pid}").exists()]
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        log.seek(0)
        return status, log.read()


@pytest.fixture(scope="module")
def whole(scan_file: Path) -> np.ndarray:
    """The volume of a run that nobody disturbed."""
    output = scan_file.with_name("whole.h5")
    assert run(command(2, scan_file, output)).returncode == 0
    return read_volume(output).values


@pytest.mark.parametrize(("killed", "size", "then"), [(1, 3, 2), (0, 2, 4)])
def test_a_killed_rank_ends_all_and_the_checkpoint_goes_on(scan_file, whole, tmp_path, killed, size, then) -> None:
    output = tmp_path / "volume.h5"
    words = command(size, scan_file, output)
    status, stderr = stop_midway(words, output, lambda process: os.kill(ranks_of(process)[killed], signal.SIGKILL))
    assert status != 0 and not output.exists()
    assert said(stderr) == []  # the launcher says which process was lost
    done = run(command(then, scan_file, output, "--resume"))
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(read_volume(output).values, whole)
    assert not list(tmp_path.glob("*.checkpoint*"))


@pytest.mark.parametrize(("number", "expected"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_to_mpiexec_keeps_what_there_is(scan_file, whole, tmp_path, number, expected) -> None:
    output = tmp_path / "volume.h5"
    words = command(2, scan_file, output)
    status, stderr = stop_midway(words, output, lambda process: process.send_signal(number))
    assert status == expected, stderr
    assert [line.split(" iteration")[0] for line in said(stderr)] == ["phyradgs: interrupted at"]
    assert partial_path(output).exists() and not output.exists()
    assert run(command(1, scan_file, output, "--resume")).returncode == 0
    np.testing.assert_array_equal(read_volume(output).values, whole)


def test_one_rank_that_fails_ends_all_with_its_line(scan_file, tmp_path) -> None:
    output = tmp_path / "volume.h5"
    alone = command(1, scan_file, output)
    done = run([*alone, ":", "-n", "1", "-env", "PHYRADGS_MEMORY", "100K", *alone[3:]])
    (line,) = said(done.stderr)
    assert done.returncode == 6 and line.startswith("phyradgs: rank 1: ") and "PHYRADGS_MEMORY" in line
    assert not output.exists()


def test_what_is_wrong_is_said_once(scan_file, tmp_path) -> None:
    for more, status, line in (
        (["--device", "99"], 2, "--device: found '99'"), (["--memory", "100K"], 6, "memory of"),
        (["--method", "phyradgs", "--set", "batch=2"], 2, "batch: found 2 for 3 ranks"),
    ):  # fmt: skip
        words = ["reconstruct", str(scan_file), "-o", str(tmp_path / "v.h5"), *more]
        done = run([MPIEXEC, "-n", "3", *PHYRADGS, *words])
        (found,) = said(done.stderr)
        assert done.returncode == status and found.startswith(f"phyradgs: {line}")


def test_the_program_of_the_docs_works_with_mpiexec_and_without(scan_file, tmp_path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "cluster.md").read_text(encoding="utf-8")
    program = next(b for b in re.findall(r"```python\n(.*?)```", text, re.S) if "launched_ranks" in b)
    (tmp_path / "run.py").write_text(program)
    shutil.copy(scan_file, tmp_path / "scan.h5")
    for launcher, ranks in (([MPIEXEC, "-n", "2"], 2), ([], 1)):
        words = [*launcher, sys.executable, "-m", "mpi4py", "run.py"]
        done = subprocess.run(words, env=QUIET, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        assert read_volume(tmp_path / "volume.h5").provenance["ranks"] == ranks


def test_the_benchmark_runs(tmp_path) -> None:
    script, out = Path(__file__).parents[2] / "benchmarks" / "mpi_scaling.py", tmp_path / "facts.json"
    done = run([sys.executable, str(script), "--quick", "--ranks", "1,2", "--json", str(out)])
    assert done.returncode == 0, done.stderr
    facts = json.loads(out.read_text())
    assert [(one["ranks"], len(one["by_rank"])) for one in facts["strong"]] == [(1, 1), (2, 2)]
    assert all(rank["kernels_ms"] > 0 for one in facts["weak"] for rank in one["by_rank"])
    assert 0 < facts["exchange_share_of_two"] < 1 and "64" in facts["predicted"]["400 Gbit/s"]
