"""Ctrl-C at every stage: one line, status 130, outputs whole or as they were; volumes of which all readers say so."""

import signal
import subprocess
import sys
import textwrap

import h5py
import numpy as np
import pytest

from phyradgs_cl import signals
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import partial_path, read_volume, write_volume
from phyradgs_cl.progress import Ticker
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.signals import finish_despite_interrupt, stop_on_interrupt
from phyradgs_cl.workflow import reconstruct, scans, volumes

pytestmark = pytest.mark.slow
NOTHING = "phyradgs: interrupted, nothing new written\n"
COMPLETE = "phyradgs: interrupted, the output is complete\n"


def interrupted_before(function):
    """``function``, with Ctrl-C pressed as it begins."""

    def wrapped(*arguments, **options):
        signal.raise_signal(signal.SIGINT)
        return function(*arguments, **options)

    return wrapped


COMMANDS = {
    "simulate": ["simulate", "--size", "8", "--detector", "12", "--views", "4"],
    "reconstruct": ["reconstruct", "{scan}", "--method", "phyradgs", "--iterations", "4", "--gaussians", "20"],
    "fdk": ["reconstruct", "{scan}", "--method", "fdk"],
    "evaluate": ["evaluate", "{volume}", "--reference", "{scan}"],
}
STAGES = [("simulate", scans, "simulated_scan"), ("reconstruct", reconstruct, "hashing"), ("fdk", Runtime, "launch")]
FINISHED = [
    ("simulate", scans, "write_scan"), ("reconstruct", reconstruct, "write_volume"), ("evaluate", volumes, "slices_png"),
]  # fmt: skip


@pytest.mark.parametrize(("command", "owner", "step"), STAGES)
def test_before_the_output_there_is_nothing(cli, scan, tmp_path, capfd, monkeypatch, command, owner, step):
    (output := tmp_path / "existing.h5").write_bytes(b"an older result")
    monkeypatch.setattr(owner, step, interrupted_before(getattr(owner, step)))
    arguments = [a.format(scan=scan) for a in COMMANDS[command]]
    assert cli.run([*arguments, "-o", str(output)]) == 130 and capfd.readouterr().err.endswith(NOTHING)
    assert output.read_bytes() == b"an older result" and list(tmp_path.iterdir()) == [output]


@pytest.mark.parametrize(("command", "owner", "step"), FINISHED)
def test_what_is_being_written_is_finished(cli, scan, tmp_path, capfd, monkeypatch, command, owner, step):
    volume = tmp_path / "volume.h5"
    assert cli.run(["reconstruct", str(scan), "--method", "fdk", "-o", str(volume)]) == 0
    output, option = (tmp_path / "out.png", "--picture") if command == "evaluate" else (tmp_path / "output.h5", "-o")
    monkeypatch.setattr(owner, step, interrupted_before(interrupted_before(getattr(owner, step))))
    words = [word.format(scan=scan, volume=volume) for word in COMMANDS[command]]
    assert cli.run([*words, option, str(output)]) == 130
    said = capfd.readouterr().err
    assert said.splitlines()[-1] == COMPLETE.strip() and "nothing written" not in said and "Traceback" not in said
    assert output.stat().st_size > 1000 and set(tmp_path.iterdir()) == {volume, output}
    assert output.suffix == ".png" or "entry" in h5py.File(output)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def at_a_kernel(kernel: str = "press", before: str = "") -> str:
    """A program that does what ``kernel`` does where a kernel is built."""
    return f"{textwrap.dedent(before)}\nimport phyradgs_cl.runtime as r\nr.Runtime.kernel = {kernel}\n"


# Each program presses Ctrl-C itself, at a stage of its own, in a process that starts as a user's would.
PROCESSES = {
    "while libraries load": """
        class Press:
            def find_spec(self, name, path, target=None):
                if name == "typer":
                    press()
        sys.meta_path.insert(0, Press())
    """,
    "as kill asks": at_a_kernel("lambda *_, **__: signal.raise_signal(signal.SIGTERM)"),
    "and again while the line is printed": at_a_kernel(
        before="""
        import typer
        echo = typer.echo
        typer.echo = lambda *words, **options: (echo(*words, **options), press())
        """
    ),
    "while the output is half written": """
        import h5py
        h5py.Group.require_group = h5py.Group.create_group = press
        import phyradgs_cl.workflow.scans as w
        w.finish_despite_interrupt = contextlib.nullcontext  # as in a command that does not make signals wait
    """,
}


@pytest.mark.parametrize("stage", PROCESSES)
def test_a_process_ends_with_one_line_and_130(tmp_path, monkeypatch, stage):
    monkeypatch.chdir(tmp_path)
    done = run_process([*COMMANDS["simulate"], "-o", str(tmp_path / "scan.h5")], PROCESSES[stage])
    assert done.returncode == (143 if "SIGTERM" in PROCESSES[stage] else 130), done.stderr
    lines = done.stderr.splitlines(keepends=True)
    assert "".join(line for line in lines if not line.startswith("frame 4/4")) == NOTHING
    assert done.stdout == "" and list(tmp_path.iterdir()) == []


def test_a_library_that_swallows_the_signal_delays_the_end(tmp_path) -> None:
    """The command ends after the output is written: a loop, or a block that writes, sees that a signal has come."""
    before = """
        import phyradgs_cl.runtime as r
        make = r.Runtime.kernel
        def kernel(*words, **options):
            with contextlib.suppress(BaseException):
                press()
            return make(*words, **options)
        """
    done = run_process([*COMMANDS["simulate"], "-o", str(tmp_path / "scan.h5")], at_a_kernel("kernel", before))
    assert done.returncode == 130 and done.stderr.endswith(COMPLETE) and list(tmp_path.iterdir()) == [tmp_path / "scan.h5"]


# A signal at the second report of a loop: it comes again at once, as wrappers pass it on.
AT_A_REPORT = """
    import phyradgs_cl.progress as p
    def pressed(ticker, done, total, *more):
        if done >= 2:
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)
        ticker.is_terminal = False
    p.Ticker.show = pressed
"""


def test_a_loop_is_saved_beside_the_output_and_goes_on(cli, told, scan, tmp_path):
    """Splats, which report every 50 iterations, in a process of Python: api/test_interrupts.py."""
    output, whole = tmp_path / "volume.h5", tmp_path / "whole.h5"
    output.write_bytes(b"an older result")
    command = ["reconstruct", str(scan), "--method", "sart", "--iterations", "8", "-o"]
    done = run_process([*command, str(output), "--preview", str(tmp_path / "now.png")], AT_A_REPORT)
    assert done.returncode == 143
    assert done.stderr == "phyradgs: interrupted at iteration 2 of 8: repeat the command with --resume to continue\n"
    partial = tmp_path / "volume.partial.h5"
    assert done.stdout.startswith(f"{partial}: sart") and output.read_bytes() == b"an older result"
    left = {"volume.h5", "volume.h5.checkpoint.npz", "volume.partial.h5"}
    assert {path.name for path in tmp_path.iterdir()} - {"now.partial.png"} == left
    facts = told("evaluate", partial, "--reference", scan, "--json")
    assert (facts["interrupted_at"], facts["iterations_asked"]) == (2, 8)
    (tmp_path / "volume.partial.evaluated.png").unlink()
    assert cli.run([*command, str(output), "--resume", "--preview", str(tmp_path / "now.png")]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"volume.h5", "now.png"}
    assert cli.run([*command, str(whole)]) == 0
    np.testing.assert_array_equal(read_volume(output).values, read_volume(whole).values)


def test_a_run_that_is_interrupted_in_its_last_iteration_is_told_in_full(cli, scan, tmp_path, capfd, monkeypatch) -> None:
    """Its volume, pictures, quality and page are those of a complete run."""

    def press(ticker: Ticker, done: int, total: int, *more: object) -> None:
        if done == total:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Ticker, "show", press)
    monkeypatch.chdir(tmp_path)
    words = ["--method", "sart", "--iterations", "3", "--preview", "now.png", "--live", "page.html"]
    assert cli.run(["reconstruct", str(scan), *words, "-o", "volume.h5"]) == 130
    said = capfd.readouterr()
    assert said.out.startswith("volume.h5: sart") and "PSNR" in said.out and said.err.splitlines()[-1] == COMPLETE.strip()
    assert {path.name for path in tmp_path.iterdir()} == {"volume.h5", "now.png", "page.html"}
    assert 'id="provenance"' in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_ctrl_c_that_ends_the_compiler_of_a_kernel_is_no_failure_of_the_device(scan, tmp_path):
    """And a signal after the last line changes nothing."""
    done = run_process(["info", str(scan)], "import atexit\natexit.register(signal.raise_signal, signal.SIGINT)")
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("kind")
    command = ["reconstruct", str(scan), "--method", "sirt", "-o", str(tmp_path / "volume.h5")]
    for first, status, said in (("press()", 130, NOTHING), ("pass", 5, "linker command failed")):
        body = f"""
            import phyradgs_cl.reconstructors.voxels.run as i
            from phyradgs_cl.errors import DeviceError
            def iterate(run):
                {first}
                raise DeviceError("kernel rays.cl", "linker command failed", "a program that builds")
            i.Iterations.step = iterate
        """
        done = run_process(command, body)
        assert done.returncode == status and said in done.stderr and done.stderr.count("\n") == 1


def test_a_second_ctrl_c_does_not_wait_unless_it_is_the_same_press_and_an_ignored_one_stays_ignored(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(signals.time, "monotonic", lambda: now[0])
    with pytest.raises(KeyboardInterrupt), stop_on_interrupt() as request:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        assert request.is_set
        now[0] += 2
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # until the test ends: tests/conftest.py
    with signals.answer_signals(), stop_on_interrupt() as request, finish_despite_interrupt():
        signal.raise_signal(signal.SIGINT)
    assert not request.is_set and signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def run_process(arguments, body):
    """The command line in a process that runs ``body`` first."""
    program = (
        "import contextlib, os, signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def press(*_, **__):\n    signal.raise_signal(signal.SIGINT)\n"
        f"sys.argv = {['phyradgs', *arguments]!r}\n"
        f"from phyradgs_cl.__main__ import main\n{textwrap.dedent(body)}\nmain()\n"
    )
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)


SAID = "interrupted at iteration 812 of 3000"
READERS = (
    "evaluate v.h5 --reference v.h5 --json", "info v.h5 --json", "report v.h5 -o page.html", "export v.h5 --to npy",
    "simulate --volume v.h5 --detector 8 --views 2 -o scan.h5",
)  # fmt: skip


@pytest.mark.parametrize("line", READERS)
def test_a_reader_says_where_the_run_was_interrupted(told, tmp_path, monkeypatch, caplog, line) -> None:
    monkeypatch.chdir(tmp_path)
    grid, history = Grid.cube(6, 2.0), {"method": "sirt", "interrupted_at": 812, "options": {"iterations": 3000}}
    write_volume("v.h5", np.linspace(0, 1, 216, dtype=np.float32).reshape(grid.shape), grid, history)
    facts = told(line.replace("v.h5", str(tmp_path / "v.h5")))
    assert caplog.text.count(SAID) == 1 and f"{tmp_path}/v.h5: {SAID}" in caplog.text
    assert "--json" not in line or (facts["interrupted_at"], facts["iterations_asked"]) == (812, 3000)


def test_a_partial_volume_has_a_name_of_its_own_where_no_scan_lies(refused, tmp_path) -> None:
    for name in ("v.partial.h5", "volume", ".hidden", "a.b.h5"):
        assert (path := partial_path(tmp_path / name)).parent == tmp_path and path.name != name and ".partial" in path.name
    (scan := tmp_path / "volume.partial.h5").write_bytes(b"a scan")
    refused(["reconstruct", scan, "-o", tmp_path / "volume.h5", "--method", "fdk"], "reads or writes")
    assert list(tmp_path.iterdir()) == [scan]
