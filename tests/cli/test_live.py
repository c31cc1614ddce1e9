"""What is said on the way, and changes no run: lines of progress, --live, a page, and --preview, a picture."""

from unittest.mock import Mock

import numpy as np
import pytest
from skimage.io import imread

from phyradgs_cl import progress
from phyradgs_cl.errors import OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import only_run, partial_path, read_volume
from phyradgs_cl.progress import Ticker
from phyradgs_cl.reconstructors import Progress
from phyradgs_cl.report import Preview
from phyradgs_cl.text import clock

pytestmark = pytest.mark.slow


def test_a_run_with_a_page_and_pictures_is_the_same_run_and_ends_as_its_report(cli, scan, tmp_path) -> None:
    page, picture, seen, plain = (tmp_path / name for name in ("run.html", "now.png", "seen.h5", "plain.h5"))
    for output, more in ((seen, ["--live", str(page), "--preview", str(picture)]), (plain, [])):
        assert cli.run(["reconstruct", str(scan), "-o", str(output), "--method", "sirt", "--iterations", "3", *more]) == 0
    np.testing.assert_array_equal(read_volume(seen).values, read_volume(plain).values)
    text = page.read_text(encoding="utf-8")
    assert 'id="provenance"' in text and 'id="projections"' in text and "live-data" not in text
    assert imread(picture).max() > 0
    assert {path.name for path in tmp_path.iterdir()} == {"run.html", "now.png", "seen.h5", "plain.h5"}


def test_an_error_of_the_run_stands_on_its_page_and_leaves_an_earlier_one_alone(cli, refused, scan, tmp_path) -> None:
    page, output = tmp_path / "run.html", tmp_path / "v.h5"
    command = ["reconstruct", str(scan), "-o", str(output), "--method", "fdk", "--resume", "--live", str(page)]
    assert cli.run(command) == 2
    text = page.read_text(encoding="utf-8")
    assert "Stopped by an error: --resume" in text and "stopped – v.h5" in text
    page.write_text("an earlier report", encoding="utf-8")
    refused(command, "--resume")
    refused(["reconstruct", scan, "-o", output, "--size", "100000", "--live", page], "100000")
    assert page.read_text(encoding="utf-8") == "an earlier report"


def test_an_interrupted_run_says_how_to_go_on(cli, scan, tmp_path, monkeypatch) -> None:
    def press(ticker: Ticker, done: int, total: int, *more: object) -> None:
        if done == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(Ticker, "show", press)
    page, words = tmp_path / "run.html", ["--method", "sirt", "--iterations", "5"]
    command = ["reconstruct", str(scan), "-o", str(tmp_path / "v.h5"), *words, "--live", str(page)]
    assert cli.run(command) == 130
    text = page.read_text(encoding="utf-8")
    assert "Interrupted at iteration 2 of 5: repeat the command with --resume to continue." in text
    assert '"is_over":true' in text and "after iteration" in text  # the last pictures stay
    monkeypatch.undo()
    assert cli.run([*command, "--resume"]) == 0 and 'id="provenance"' in page.read_text(encoding="utf-8")


@pytest.mark.parametrize(("flag", "suffix", "other"), [("--live", "html", "a.txt"), ("--preview", "png", "a.jpg")])
def test_pages_and_pictures_do_not_replace_what_matters(refused, scan, tmp_path, flag, suffix, other) -> None:
    output, before = tmp_path / f"volume.{suffix}", scan.read_bytes()
    for path in (scan, output, partial_path(output), tmp_path / other):
        refused(["reconstruct", scan, "-o", output, flag, path], flag)
    refused(["reconstruct", scan, "-o", output, flag, tmp_path / "none" / f"now.{suffix}"], "none", status=4)
    assert scan.read_bytes() == before and not list(tmp_path.iterdir())


@pytest.mark.parametrize(("flag", "name"), [("--live", "run.html"), ("--preview", "now.png")])
def test_two_runs_do_not_share_a_page_or_a_picture(cli, refused, scan, tmp_path, flag, name) -> None:
    path, output = tmp_path / name, tmp_path / "v.h5"
    command = ["reconstruct", str(scan), "-o", str(output), "--method", "fdk", flag, str(path)]
    with only_run(path):
        refused(command, f"{path}: found another run at work on it", status=4)
    assert not list(tmp_path.iterdir()) and cli.run(command) == 0 and path.exists()


GRID = Grid.cube(4, 2.0)


def test_the_picture_is_of_the_present_volume(tmp_path) -> None:
    pictures, preview = [], Preview(tmp_path / "now.png", every_s=0.0)
    for value in (0.0, 1.0):
        volume = np.zeros(GRID.shape, np.float32)
        volume[2, 2, 2] = value
        preview(Progress(1, 9, 0.5, 0, 1.0, volume=lambda v=volume: (v, GRID)))
        pictures.append(imread(tmp_path / "now.partial.png"))
    assert pictures[0].max() == 0 and pictures[1].max() == 255
    preview.finish(volume, GRID)
    assert [path.name for path in tmp_path.iterdir()] == ["now.png"]


def test_pictures_are_no_more_often_than_asked_and_cost_one_warning(tmp_path, monkeypatch, caplog) -> None:
    made = []
    progress = Progress(1, 9, 0.5, 0, 1.0, volume=lambda: made.append(1) or (np.ones(GRID.shape, np.float32), GRID))
    for every_s, times in ((1000.0, 1), (0.0, 5)):
        made.clear()
        preview = Preview(tmp_path / "now.png", every_s)
        for _ in range(5):
            preview(progress)
        assert len(made) == times and caplog.text == ""
    full = OutputError("now.png", "no room left")
    monkeypatch.setattr("phyradgs_cl.report.preview.write_preview", Mock(side_effect=full))
    for _ in range(3):
        preview(progress)
    assert caplog.text.count("no preview") == 1


@pytest.fixture
def now(monkeypatch):
    """A clock in the test's hands: now[0] seconds."""
    monkeypatch.setattr(progress.time, "monotonic", lambda: seconds[0])
    return (seconds := [0.0])


def test_a_loss_comes_with_its_gaussians_and_rate_and_time_left_count_from_the_first_report(capsys, now) -> None:
    """By the share of the work that is done, where later passes take longer."""
    Ticker("iteration").progress(Progress(50, 50, 0.125, 300, 1.0))
    Ticker("iteration").progress(Progress(3, 3, 0.5, 0, 1.0, quantity="residual"))
    assert capsys.readouterr().err == "iteration 50/50  loss 0.12500  300 Gaussians\niteration 3/3  residual 0.50000\n"
    for ticker, reports, said in (
        (Ticker("frame"), ((20.0, 10, None), (40.0, 30, None)), "frame 10/100\nframe 30/100  1.0/s  ETA 1:10\n"),
        (Ticker("pass"), ((0.0, 0, 0.0), (20.0, 80, 0.25)), "pass 80/100  4.0/s  ETA 1:00\n"),
    ):
        for now[0], done, share in reports:
            ticker.show(done, 100, share=share)
        assert capsys.readouterr().err == said
    now[0] = 0.0
    ticker = Ticker("frame")  # a file gets a line every ten seconds, and the last
    for now[0] in map(float, range(31)):
        ticker.show(int(now[0]), 30)
    assert [line.split()[1] for line in capsys.readouterr().err.splitlines()] == ["10/30", "20/30", "30/30"]
    assert [clock(seconds) for seconds in (0.2, 59.6, 125, 3600)] == ["0:00", "1:00", "2:05", "1:00:00"]


def test_on_a_terminal_there_is_a_line_before_there_is_a_count(capsys, monkeypatch) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with Ticker("frame") as ticker:
        ticker.stage("reading scan.h5")
        assert capsys.readouterr().err == "\r\x1b[Kreading scan.h5"
        ticker.show(1, 1)
    assert capsys.readouterr().err == "\r\x1b[Kframe 1/1\n"
    with Ticker("frame") as ticker:
        ticker.stage("reading")
    assert capsys.readouterr().err == "\r\x1b[Kreading\r\x1b[K"  # a result, or an error, has the line
    monkeypatch.setattr("sys.stderr", None)
    with Ticker("frame") as ticker:
        ticker.show(1, 1)
    assert not ticker.is_open  # nothing to close where nothing could be written
