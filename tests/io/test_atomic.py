"""An output file is there whole or as it was: whatever is raised, killed or full."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from phyradgs_cl.errors import OutputError
from phyradgs_cl.io import check_writable, written_beside

POSIX = os.name == "posix"


def names(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


@pytest.mark.skipif(not POSIX, reason="symbolic links and permissions of POSIX")
def test_success_replaces_the_file_a_link_stays_and_checking_writes_nothing(tmp_path) -> None:
    """Permissions are kept."""
    target, link = tmp_path / "out.txt", tmp_path / "link.txt"
    check_writable(target)
    assert names(tmp_path) == []
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to("out.txt")
    check_writable(target)
    for path in (target, link):
        with written_beside(path) as temporary:
            assert temporary.parent == tmp_path and temporary not in (target, link)
            temporary.write_text(f"new {path.name}")
            assert path.name not in target.read_text()
        assert target.read_text() == f"new {path.name}" and link.is_symlink()
        assert target.stat().st_mode & 0o777 == 0o640
    assert names(tmp_path) == ["link.txt", "out.txt"]


def test_failure_leaves_everything_as_it_was(tmp_path) -> None:
    target = tmp_path / "out.txt"
    for existing in (False, True):
        if existing:
            target.write_text("old")
        for error in (ValueError("x"), KeyboardInterrupt()):
            with pytest.raises(type(error)), written_beside(target) as temporary:
                temporary.write_text("half of the new")
                raise error
            assert names(tmp_path) == (["out.txt"] if existing else [])
            assert not existing or target.read_text() == "old"


def test_targets_that_cannot_be_files(tmp_path) -> None:
    (tmp_path / "file").write_text("a file, not a folder")
    for path in (tmp_path, f"{tmp_path}/", "", tmp_path / "file" / "out.h5", tmp_path / ("n" * 300)):
        with pytest.raises(OutputError):
            check_writable(path)
        with pytest.raises(OutputError), written_beside(path):
            raise AssertionError("must not get here")
    with pytest.raises(OutputError, match=r"no folder .*nowhere.*create the folder"):
        check_writable(tmp_path / "nowhere" / "out.h5")
    assert names(tmp_path) == ["file"]
    if POSIX:
        with pytest.raises(OutputError, match="regular file"):
            check_writable("/dev/null")
    for error, word in (
        (OSError(28, os.strerror(28)), "no room left"), (OSError(5, os.strerror(5)), "Input/output"),
        (OSError("46080 requested and 6004 written"), "no room left"),  # of NumPy's tofile
    ):  # fmt: skip
        with pytest.raises(OutputError) as caught, written_beside(tmp_path / "out.txt"):
            raise error
        assert word in str(caught.value) and str(tmp_path) in str(caught.value)
    assert names(tmp_path) == ["file"]


@pytest.mark.skipif(not POSIX, reason="SIGKILL")
def test_a_killed_writer_leaves_the_old_file(tmp_path) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")
    script = f"""
        import sys, time
        from phyradgs_cl.io import written_beside
        with written_beside({str(target)!r}) as temporary:
            temporary.write_text("half")
            print("writing", flush=True)
            time.sleep(60)
    """
    root = Path(sys.modules["phyradgs_cl"].__path__[0]).parent  # where this process found the package
    words, environment = [sys.executable, "-c", textwrap.dedent(script)], os.environ | {"PYTHONPATH": str(root)}
    with subprocess.Popen(words, env=environment, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"writing\n"
        with written_beside(target):  # whose writer is alive stays
            pass
        assert len(names(tmp_path)) == 2
        target.write_text("old")
        process.send_signal(signal.SIGKILL)
    assert target.read_text() == "old"
    left = [name for name in names(tmp_path) if name.endswith(".part")]
    assert len(left) == 1
    check_writable(tmp_path / "other.txt")
    assert left[0] in names(tmp_path)
    elsewhere = tmp_path / left[0].replace(left[0].split(".")[-2].split("-")[0], "00000000")
    elsewhere.write_text("half")
    check_writable(tmp_path / "out.h5")  # whatever the run writes: volume, checkpoint, picture
    assert names(tmp_path) == sorted([elsewhere.name, "out.txt"])
