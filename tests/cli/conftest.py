"""A scan of some voxels that the commands are tried on."""

from pathlib import Path

import pytest

WORDS = "--phantom jaw --size 8 --detector 12 --views 4 --time-samples 2 --jitter-deg 0.1"


@pytest.fixture(scope="session")
def tiny() -> list[str]:
    """Words of ``phyradgs simulate``."""
    return WORDS.split()


@pytest.fixture(scope="session")
def scan(simulated, tiny) -> Path:
    return simulated(*tiny)
