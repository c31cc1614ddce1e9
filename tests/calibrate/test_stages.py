"""How much of a calibration is done: passes counted, their costs, and the time left that follows."""

import pytest

from phyradgs_cl.api import simulate
from phyradgs_cl.calibrate import calibrate
from phyradgs_cl.calibrate.problem import PassCounter

pytestmark = pytest.mark.slow


def test_the_share_is_of_costs_and_what_is_not_needed_is_taken_out() -> None:
    told = []
    plan = {"coarse": (4, 4.0), "middle": (5, 40.0), "fine": (2, 128.0)}
    work = PassCounter(lambda *report: told.append(report), plan)
    work.begin("coarse", "24 columns")
    count = work.counter(1.0)
    count()
    assert told == [(0, 11, "24 columns", 0.0), (1, 11, "24 columns", pytest.approx(1 / 172))]
    work.begin("fine", "96 columns")  # the first ended early, the second is not needed
    assert told[-1] == (1, 3, "96 columns", pytest.approx(1 / 129))
    for _ in range(2):
        work.counter(64.0)()
    assert told[-1] == (3, 3, "96 columns", 1.0)


@pytest.mark.parametrize(("what", "protocol"), [("offset-u,direction", "rapid"), ("wobble", "static")])
def test_a_calibration_ends_where_it_said_that_it_would(rt, what, protocol) -> None:
    """Every pass is counted, none twice, and there were no more than planned."""
    scan = simulate("foot", size=12, detector=16, views=12, protocol=protocol, device=rt)
    told = []
    calibrate(scan, rt, what, report=lambda *report: told.append(report))
    done, totals, words, shares = zip(*told, strict=True)
    assert list(done) == sorted(done) and list(shares) == sorted(shares) and done[-1] > 20
    assert done[-1] == totals[-1] <= totals[0] and shares[-1] == pytest.approx(1.0)
    assert words[0] == "where the axis is" and words[-1] == "residuals"
