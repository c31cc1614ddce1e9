"""What is said on the way: the quantity by its name, Gaussians where there are any, time left."""

import pytest

from phyradgs_cl import progress
from phyradgs_cl.progress import Ticker
from phyradgs_cl.reconstructors import Progress
from phyradgs_cl.text import clock

pytestmark = pytest.mark.slow


@pytest.fixture
def now(monkeypatch):
    """A clock in the test's hands: now[0] seconds."""
    seconds = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: seconds[0])
    return seconds


def test_a_loss_comes_with_its_gaussians_and_a_residual_without(capsys) -> None:
    Ticker("iteration").progress(Progress(50, 50, 0.125, 300, 1.0))
    assert capsys.readouterr().err == "iteration 50/50  loss 0.12500  300 Gaussians\n"
    Ticker("iteration").progress(Progress(3, 3, 0.5, 0, 1.0, quantity="residual"))
    assert capsys.readouterr().err == "iteration 3/3  residual 0.50000\n"


def test_rate_and_time_left_count_from_the_first_report(capsys, now) -> None:
    """By the share of the work that is done, where later passes take longer."""
    for ticker, reports, said in (
        (Ticker("frame"), ((20.0, 10, None), (40.0, 30, None)), "frame 10/100\nframe 30/100  1.0/s  ETA 1:10\n"),
        (Ticker("pass"), ((0.0, 0, 0.0), (20.0, 80, 0.25)), "pass 80/100  4.0/s  ETA 1:00\n"),
    ):
        for now[0], done, share in reports:
            ticker.show(done, 100, share=share)
        assert capsys.readouterr().err == said
    times = {0.2: "0:00", 59.6: "1:00", 125: "2:05", 3600: "1:00:00"}
    assert {seconds: clock(seconds) for seconds in times} == times


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


def test_a_file_gets_a_line_every_ten_seconds_and_the_last(capsys, now) -> None:
    ticker = Ticker("frame")
    for second in range(31):
        now[0] = float(second)
        ticker.show(second, 30)
    assert [line.split()[1] for line in capsys.readouterr().err.splitlines()] == ["10/30", "20/30", "30/30"]
