"""docs/orbits.md is one program that works: each orbit's scan gives its object back, as far as the orbit sees it."""

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "orbits.md").read_text(encoding="utf-8")


def test_the_recipes_run() -> None:
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", TEXT, re.S):
        exec(compile(block, "docs/orbits.md", "exec"), names)
    least = {"helix": 28, "laminography": 28, "tomosynthesis": 18, "half-fan": 28, "half-fan, FDK": 26}
    quality: dict[str, float] = names["quality"]  # type: ignore[assignment]
    assert set(quality) == set(least)
    assert all(quality[name] > least[name] for name in least), quality
