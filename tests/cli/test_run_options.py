"""The options of a reconstruction, as commands get them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from phyradgs_cl.commands.run_options import RUN_OPTIONS, RunRequest, with_run_options


@pytest.fixture
def asked() -> tuple[typer.Typer, list[object]]:
    seen: list[object] = []
    app = typer.Typer()

    @app.command()
    @with_run_options("seed", "batch")
    def command(scan: str, request: RunRequest, often: Annotated[float, typer.Option()] = 2.0) -> None:
        """What it does."""
        seen.extend([scan, request, often])

    return app, seen


def test_a_command_gets_what_was_given_and_none_for_the_rest(asked, tmp_path: Path) -> None:
    app, seen = asked
    config = tmp_path / "options.toml"
    words = ["s.h5", "--method", "sirt", "--motion", "per-row", "--often", "3", "--ignore-lag"]
    words += ["--set", "relaxation=0.5", "--set", "iterations=3", "--config", str(config), "--memory", "1GiB"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    scan, request, often = seen
    assert (scan, often, request.config) == ("s.h5", 3.0, config)
    assert request.assignments == ["relaxation=0.5", "iterations=3"]
    given = {name: value for name, value in request.given.items() if value is not None}
    assert given == {"method": "sirt", "motion": "per-row", "ignore_lag": True, "memory": "1GiB"}
    assert set(request.given) == set(RUN_OPTIONS) - {"seed", "batch", "config", "assignments"}
    config.write_text("iterations = 7\nseed = 5\n", encoding="utf-8")
    settings = request.settings()
    assert (settings.method, settings.seed, settings.memory) == ("sirt", 5, 2**30)
    assert (settings.changes["iterations"], settings.changes["relaxation"]) == (3, 0.5)


def test_nothing_given_is_nothing_given_and_what_is_left_out_is_no_option(asked) -> None:
    app, seen = asked
    for option in ("--seed", "--batch"):
        assert CliRunner().invoke(app, ["s.h5", option, "1"]).exit_code == 2 and seen == []
    assert CliRunner().invoke(app, ["s.h5"]).exit_code == 0
    assert seen[1] == RunRequest(None, [], dict.fromkeys(seen[1].given))


def test_the_help_has_the_options_in_the_place_of_the_request(asked) -> None:
    text = CliRunner().invoke(asked[0], ["--help"], env={"COLUMNS": "200"}).output
    order = [text.index(f"--{name}") for name in ("method", "motion", "config", "set", "memory", "often")]
    assert order == sorted(order) and "What it does." in text and "request" not in text.lower()
