"""Ctrl-C in a script: the script stops, and the volume so far is not lost."""

import io
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import h5py
import numpy as np
import pytest

from phyradgs_cl import api
from phyradgs_cl.api import Progress, reconstruct

pytestmark = pytest.mark.slow
SCRIPT = """
import sys
import phyradgs_cl.api as api
scan = api.simulate("jaw", size=12, detector=20, views=6)

def tell(progress):
    print("iteration", progress.iteration, flush=True)

try:
    api.reconstruct(scan, "sirt", iterations=1_000_000, report=tell)
except KeyboardInterrupt as error:
    print("partial", error.partial.facts["interrupted_at"], flush=True)
    api.save_volume("partial.h5", error.partial)
    raise
print("the next line")
"""


def test_a_script_stops_with_the_partial_volume(tmp_path) -> None:
    """One real SIGINT after the first report."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    child = subprocess.Popen([sys.executable, "-c", SCRIPT], cwd=tmp_path, **pipes)
    (watchdog := threading.Timer(100, child.kill)).start()
    child.stdout.readline()
    child.send_signal(signal.SIGINT)
    said, errors = child.communicate()
    watchdog.cancel()
    assert child.returncode == -signal.SIGINT and "the next line" not in said  # by the signal, as shells want it
    (told,) = [line for line in said.split("\n") if line.startswith("partial")]
    assert errors.rstrip().split("\n")[-1].endswith("the volume so far is the error's partial")
    assert "direct cause" not in errors  # one traceback, from the reconstruction
    kept = api.load_volume(tmp_path / "partial.h5")
    assert kept.facts["interrupted_at"] == int(told.split()[1]) > 0
    assert np.isfinite(kept.volume).all() and kept.volume.max() > 0


def pressing_at(iteration: int):
    """A report that presses Ctrl-C."""

    def tell(progress: Progress) -> None:
        if progress.iteration == iteration:
            signal.raise_signal(signal.SIGINT)

    return tell


def test_the_partial_result_goes_on_to_the_bits_of_the_whole(rt, scan, tmp_path) -> None:
    """As other methods do without a file: tests/reconstructors."""
    options = {"method": "sart", "iterations": 8, "device": rt}
    with pytest.raises(KeyboardInterrupt) as stopped:
        reconstruct(scan, **options, report=pressing_at(2))
    partial = stopped.value.partial
    assert "interrupted at iteration" in repr(partial)
    assert f"after iteration {partial.facts['interrupted_at']}" in str(stopped.value)
    whole = reconstruct(scan, **options, report=False)
    api.save_volume(tmp_path / "partial.h5", partial)
    for so_far in (partial, api.load_volume(tmp_path / "partial.h5")):
        np.testing.assert_array_equal(reconstruct(scan, **options, resume=so_far, report=False).volume, whole.volume)
    with h5py.File(tmp_path / "partial.h5", "a") as file:
        del file["entry/state/iteration"]
        file.create_group("entry/state/iteration")
    assert api.load_volume(tmp_path / "partial.h5").state is None  # the volume is good without
    with pytest.raises(api.InputError, match="resume: found a run with other iterations"):
        reconstruct(scan, **options | {"iterations": 9}, resume=partial)


def test_another_run_is_not_gone_on_with(rt, scan) -> None:
    options = {"method": "sirt", "iterations": 4, "device": rt}
    partial = reconstruct(scan, **options, report=pressing_at(2), on_interrupt="return")
    wider, mask = replace(scan.grid, voxel_size_mm=(0.5, 0.5, 0.5)), np.zeros(scan.projections.shape[1:], bool)
    mask[3] = True
    for given, changes, words in [
        (replace(scan, projections=scan.projections[::-1]), {}, "scan"), (replace(scan, pixel_mask=mask), {}, "scan"),
        (scan, {"seed": 1}, "seed"), (scan, {"holdout": 3}, "input.holdout"), (scan, {"initial": partial}, "initial"),
        (scan, {"grid": wider}, "grid"),
    ]:  # fmt: skip
        with pytest.raises(api.InputError, match=f"resume: found a run with other .*{words}"):
            reconstruct(given, **options, **changes, resume=partial)
    again = reconstruct(scan, **options, resume=partial, report=pressing_at(3), on_interrupt="return")
    assert again.facts["interrupted_at"] == 3 and again.state["run"] == partial.state["run"]


def test_ctrl_c_is_never_lost(rt, scan) -> None:
    """In the last iteration, where the result is whole, and before the first, where there is none."""
    with pytest.raises(KeyboardInterrupt) as late:
        reconstruct(scan, "sirt", iterations=3, report=pressing_at(3), device=rt)
    assert late.value.partial.state is None and late.value.partial.volume.shape == scan.grid.shape

    def early(scan, options, rt):
        signal.raise_signal(signal.SIGINT)

    for how in ("raise", "return"):
        with pytest.raises(KeyboardInterrupt, match="before there was a volume") as nothing:
            reconstruct(scan, early, device=rt, on_interrupt=how)
        assert nothing.value.partial is None
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


class Screen(io.StringIO):
    """A stream that is a terminal or not."""


class NotebookScreen(Screen):
    """The stream of a notebook's kernel."""

    __module__ = "ipykernel.iostream"


@pytest.mark.parametrize(("kind", "is_terminal", "report", "is_told"), {
    "terminal": (Screen, True, True, True), "notebook": (NotebookScreen, False, True, True),
    "a file": (Screen, False, True, False), "a function": (Screen, True, lambda progress: None, False),
}.values())  # fmt: skip
def test_a_line_tells_how_far_it_is(rt, scan, monkeypatch, kind, is_terminal, report, is_told) -> None:
    monkeypatch.setattr(sys, "stderr", screen := kind())
    screen.isatty = lambda: is_terminal
    reconstruct(scan, "sirt", iterations=5, device=rt, report=report)
    said = screen.getvalue()
    assert ("iteration 5/5  residual" in said) == is_told
    if is_told:
        assert said.endswith("\n") and said.count("\n") == 1 and "ETA" in said and ("\x1b[K" in said) == is_terminal
