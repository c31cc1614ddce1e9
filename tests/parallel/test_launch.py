"""How launchers are recognised, who takes which share, and what is said where the extra is missing."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from phyradgs_cl.commands import console as commands
from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.parallel import Launch, launched
from phyradgs_cl.runtime import device as devices

pytestmark = pytest.mark.slow
OPEN_MPI = dict(zip(("RANK", "SIZE", "LOCAL_RANK", "LOCAL_SIZE"), "5623", strict=True))
LOCAL = {"MPI_LOCALRANKID": "1", "MPI_LOCALNRANKS": "2"}
TASKS = {"SLURM_STEP_TASKS_PER_NODE": "2(x2)"}
FIRST = {"SLURM_LOCALID": "0", **TASKS}
# name: (environment, rank, size and the same of the machine)
LAUNCHERS = {
    "MPICH": ({"PMI_RANK": "3", "PMI_SIZE": "8", **LOCAL}, (3, 8, 1, 2)),
    "Open MPI": ({f"OMPI_COMM_WORLD_{name}": value for name, value in OPEN_MPI.items()}, (5, 6, 2, 3)),
    "srun, PMI-2": ({"PMI_RANK": "3", "PMI_SIZE": "4", "SLURM_LOCALID": "1", **TASKS}, (3, 4, 1, 2)),
    "srun, PMIx": ({"PMIX_RANK": "2", "SLURM_STEP_NUM_TASKS": "4", **FIRST}, (2, 4, 0, 2)),
    "a job of four tasks, no step": ({"SLURM_NTASKS": "4", "SLURM_PROCID": "0"}, (0, 1, 0, 1)),
    "nobody": ({}, (0, 1, 0, 1)),
}


def test_launchers() -> None:
    for name, (environment, expected) in LAUNCHERS.items():
        assert launched(environment) == Launch(*expected), name


def test_ranks_of_a_machine_take_devices_in_turns(monkeypatch) -> None:
    found = [
        SimpleNamespace(index=index, name=name, platform="P", kind="gpu", by_default=True, rank=(rank,))
        for index, (name, rank) in enumerate(2 * [("small", 1), ("large", 2)])
    ]
    monkeypatch.setattr(devices, "list_devices", lambda: found)
    monkeypatch.delenv(devices.DEVICE_VARIABLE, raising=False)
    for wish, expected in {
        None: [1, 3, 1, 3], "gpu": [1, 3, 1, 3],  # the best two are alike, the CPU is not taken
        "3,1,0": [3, 1, 0, 3], "3": [3, 3, 3, 3],  # what is named by its index is meant
        "small": [0, 2, 0, 2],
    }.items():  # fmt: skip
        assert [devices.choose_device(wish, turn)[0].index for turn in range(4)] == expected, wish


def test_other_commands_are_rank_0_s(monkeypatch) -> None:
    monkeypatch.setattr(commands, "launched", lambda: Launch(0, 2))
    assert commands.takes_part(["info", "x"])
    monkeypatch.setattr(commands, "launched", lambda: Launch(1, 2))
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # put back afterwards
    monkeypatch.setattr(sys, "stderr", sys.stderr)
    assert not commands.takes_part(["info", "x"])
    assert commands.takes_part(["reconstruct", "x"])
    assert sys.stdout is None


HIDDEN = """
import sys
sys.modules["mpi4py"] = None  # as where it is not installed
from phyradgs_cl.__main__ import load_cli
sys.exit(load_cli().run(sys.argv[1:]))
"""


@pytest.mark.parametrize("rank", [0, 1])
def test_without_mpi4py_one_line_says_what_to_install(tmp_path, rank) -> None:
    environment = {**os.environ, "PMI_RANK": str(rank), "PMI_SIZE": "2"}
    run = [sys.executable, "-c", HIDDEN, "reconstruct", "scan.h5", "-o", str(tmp_path / "v.h5")]
    done = subprocess.run(run, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    said = done.stderr.splitlines()
    assert len(said) == (rank == 0) and all('pip install "phyradgs-cl[mpi]"' in line for line in said)


def test_the_last_words_of_a_rank(monkeypatch, capfd) -> None:
    monkeypatch.setenv("PMI_SIZE", "3")
    for rank, name in (("0", ""), ("2", "rank 2: ")):
        monkeypatch.setenv("PMI_RANK", rank)
        for error, words, status in (
            (InputError("scan.h5", "nothing", "a scan"), "scan.h5: found nothing; expected a scan\n", 2),
            (OutputError("volume.h5", "no room"), "volume.h5: found no room\n", 4),
            (KeyboardInterrupt(), "interrupted, nothing new written\n", 130),
        ):
            assert commands.last_words(error) == status
            assert capfd.readouterr().err == f"phyradgs: {name}{words}"
    assert commands.last_words(ZeroDivisionError("a defect")) == 1
    assert capfd.readouterr().err.startswith("phyradgs: rank 2: ZeroDivisionError: a defect")
    monkeypatch.setattr(commands.os, "write", lambda *_: (_ for _ in ()).throw(BrokenPipeError()))
    assert commands.last_words(InputError("scan.h5")) == 2  # a stderr that is gone costs no status
