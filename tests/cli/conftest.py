"""A scan of some voxels that the commands are tried on, and what they say."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

WORDS = "--phantom jaw --size 8 --detector 12 --views 4 --time-samples 2 --jitter-deg 0.1"


@pytest.fixture(scope="session")
def tiny() -> list[str]:
    """Words of ``phyradgs simulate``."""
    return WORDS.split()


@pytest.fixture(scope="session")
def scan(simulated, tiny) -> Path:
    return simulated(*tiny)


@pytest.fixture
def told(cli, capfd) -> Callable[..., Any]:
    """(words, or lines of them...) → what the command prints, as facts where that is JSON."""

    def tell(*lines: object) -> Any:
        words = [word for line in lines for word in str(line).split()]
        capfd.readouterr()
        assert cli.run(words) == 0, words
        said = capfd.readouterr().out
        return json.loads(said) if "--json" in words else said

    return tell
