"""How this process was started: alone, or as one of several by mpiexec or srun. Read from the environment alone."""

import os
from collections.abc import Mapping
from dataclasses import dataclass

# (rank, size, rank on this machine, ranks on this machine) as launchers name them
_LAUNCHERS = (
    (
        "OMPI_COMM_WORLD_RANK",
        "OMPI_COMM_WORLD_SIZE",
        "OMPI_COMM_WORLD_LOCAL_RANK",
        "OMPI_COMM_WORLD_LOCAL_SIZE",
    ),
    ("MV2_COMM_WORLD_RANK", "MV2_COMM_WORLD_SIZE", "MV2_COMM_WORLD_LOCAL_RANK", "MV2_COMM_WORLD_LOCAL_SIZE"),
    ("PMI_RANK", "PMI_SIZE", "MPI_LOCALRANKID", "MPI_LOCALNRANKS"),
    ("PMIX_RANK", "SLURM_STEP_NUM_TASKS", "SLURM_LOCALID", "SLURM_STEP_TASKS_PER_NODE"),
)


@dataclass(frozen=True)
class Launch:
    """rank of size processes, local_rank of local_size on this machine; 0 of 1 where nobody launched several."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1


def launched(environment: Mapping[str, str] = os.environ) -> Launch:
    """What mpiexec (MPICH, Open MPI, MVAPICH, Intel MPI) or srun says of this process; alone where none says a thing."""
    for names in _LAUNCHERS:
        rank, size, local_rank, local_size = (_whole(environment.get(name)) for name in names)
        if rank is None or size is None or size < 2:
            continue
        if local_rank is None:
            local_rank = _whole(environment.get("SLURM_LOCALID"))
        if local_size is None:
            local_size = _whole(environment.get("SLURM_STEP_TASKS_PER_NODE"))
        beside = size if local_size is None else local_size
        return Launch(rank, size, rank % beside if local_rank is None else local_rank, beside)
    return Launch()


def _whole(text: str | None) -> int | None:
    """A count; SLURM writes 4(x2) for four on each of two machines."""
    number = (text or "").split("(")[0].split(",")[0]
    return int(number) if number.isdigit() else None
