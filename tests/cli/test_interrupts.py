"""Ctrl-C at every stage: one line, status 130, and outputs that are whole or as they were."""

import signal
import subprocess
import sys

import h5py
import pytest

from phyradgs_cl import workflow
from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.runtime import Runtime

TINY = ["--phantom", "jaw", "--size", "8", "--detector", "12", "--views", "4", "--time-samples", "2"]
NOTHING = "phyradgs: interrupted, nothing written\n"


@pytest.fixture(scope="module")
def cli():
    return load_cli()


@pytest.fixture(scope="module")
def scan(cli, tmp_path_factory):
    path = tmp_path_factory.mktemp("scan") / "scan.h5"
    assert cli.run(["simulate", *TINY, "-o", str(path)]) == 0
    return path


@pytest.fixture(autouse=True)
def ctrl_c_raises():
    """A test run started in the background would ignore the signal, and hand that on to its children."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupted_before(function):
    """``function``, with Ctrl-C pressed as it begins."""

    def wrapped(*arguments, **options):
        signal.raise_signal(signal.SIGINT)
        return function(*arguments, **options)

    return wrapped


COMMANDS = {
    "simulate": ["simulate", *TINY],
    "reconstruct": ["reconstruct", "{scan}", "--iterations", "4", "--gaussians", "20"],
    "fdk": ["reconstruct", "{scan}", "--method", "fdk"],
}
STAGES = [
    ("simulate", workflow, "load_scanner"),
    ("simulate", workflow, "check_writable"),
    ("simulate", workflow, "simulate"),
    ("simulate", Runtime, "kernel"),
    ("reconstruct", workflow, "load_scan"),
    ("reconstruct", workflow, "sha256_of"),
    ("reconstruct", workflow, "compare"),
    ("fdk", Runtime, "launch"),
]


@pytest.mark.parametrize(("command", "owner", "step"), STAGES)
def test_before_the_output_there_is_nothing(cli, scan, tmp_path, capfd, monkeypatch, command, owner, step):
    output = tmp_path / "existing.h5"
    output.write_bytes(b"an older result")
    monkeypatch.setattr(owner, step, interrupted_before(getattr(owner, step)))
    arguments = [a.format(scan=scan) for a in COMMANDS[command]]
    assert cli.run([*arguments, "-o", str(output)]) == 130
    assert capfd.readouterr().err.endswith(NOTHING)
    assert output.read_bytes() == b"an older result"
    assert list(tmp_path.iterdir()) == [output]


@pytest.mark.parametrize(
    ("command", "step"),
    [("simulate", "write_scan"), ("reconstruct", "write_volume"), ("fdk", "write_volume")],
)
def test_an_output_that_is_being_written_is_finished(cli, scan, tmp_path, capfd, monkeypatch, command, step):
    output = tmp_path / "output.h5"
    monkeypatch.setattr(workflow, step, interrupted_before(interrupted_before(getattr(workflow, step))))
    arguments = [a.format(scan=scan) for a in COMMANDS[command]]
    assert cli.run([*arguments, "-o", str(output)]) == 130
    captured = capfd.readouterr().err
    assert "nothing written" not in captured
    assert "Traceback" not in captured
    with h5py.File(output) as file:
        assert "entry" in file
    assert list(tmp_path.iterdir()) == [output]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_picture_that_is_being_written_is_finished(cli, scan, tmp_path, capfd, monkeypatch):
    volume, picture = tmp_path / "volume.h5", tmp_path / "volume.png"
    assert cli.run(["reconstruct", str(scan), "--method", "fdk", "-o", str(volume)]) == 0
    monkeypatch.setattr(workflow, "slices_png", interrupted_before(workflow.slices_png))
    capfd.readouterr()
    assert cli.run(["evaluate", str(volume), "--reference", str(scan)]) == 130
    assert "nothing written" not in capfd.readouterr().err
    assert picture.stat().st_size > 1000


# Each program presses Ctrl-C itself, at a stage of its own, in a process that starts as a user's would.
PROCESSES = {
    "while libraries load": """
        class Press:
            def find_spec(self, name, path, target=None):
                if name == "typer":
                    signal.raise_signal(signal.SIGINT)
        sys.meta_path.insert(0, Press())
    """,
    "while a kernel is built": """
        import phyradgs_cl.runtime as r
        def kernel(*_, **__):
            signal.raise_signal(signal.SIGINT)
        r.Runtime.kernel = kernel
    """,
    "and again while the line is printed": """
        import typer
        import phyradgs_cl.runtime as r
        def press(*_, **__):
            signal.raise_signal(signal.SIGINT)
        r.Runtime.kernel = press
        echo = typer.echo
        def pressed(*arguments, **options):
            echo(*arguments, **options)
            press()
        typer.echo = pressed
    """,
}


@pytest.mark.parametrize("stage", PROCESSES)
def test_a_process_ends_with_one_line_and_130(tmp_path, stage):
    body = "\n".join(line.removeprefix("        ") for line in PROCESSES[stage].splitlines())
    output = tmp_path / "scan.h5"
    program = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"sys.argv = {['phyradgs', 'simulate', *TINY, '-o', str(output)]!r}\n"
        f"from phyradgs_cl.__main__ import main\n{body}\nmain()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 130, done.stderr
    assert done.stderr == NOTHING
    assert done.stdout == ""
    assert not output.exists()
