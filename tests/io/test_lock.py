"""One run per output: locks that end with their process."""

import subprocess
import sys
from pathlib import Path
from subprocess import DEVNULL, PIPE

import pytest

from phyradgs_cl.errors import OutputError
from phyradgs_cl.io import only_run
from phyradgs_cl.io.output import lock_path

pytestmark = pytest.mark.slow
HOLD = """
import sys, time
from phyradgs_cl.io import only_run
with only_run(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def refused(path: Path, words: str = "another run") -> None:
    with pytest.raises(OutputError, match=words), only_run(path):
        pass


@pytest.fixture
def holder(tmp_path):
    """Another process that is at work on volume.h5."""
    words = [sys.executable, "-c", HOLD, str(tmp_path / "volume.h5")]
    process = subprocess.Popen(words, stdout=PIPE, stderr=DEVNULL, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


def test_a_second_run_is_refused_by_any_name_of_the_output_until_the_first_is_dead(tmp_path, holder) -> None:
    (tmp_path / "link.h5").symlink_to(tmp_path / "volume.h5")
    for name in ("volume.h5", "link.h5"):
        refused(tmp_path / name)
    with only_run(tmp_path / "other.h5"):
        assert holder.poll() is None
    holder.kill()
    holder.wait()
    assert lock_path(tmp_path / "volume.h5").exists()
    with only_run(tmp_path / "volume.h5"):
        assert lock_path(tmp_path / "volume.h5").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["link.h5"]


def test_a_run_beside_it_in_the_same_process_is_refused(tmp_path) -> None:
    output = tmp_path / "volume.h5"
    with only_run(output):
        refused(output)
    with only_run(output):
        pass
    with pytest.raises(ZeroDivisionError), only_run(tmp_path / "volume.h5"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_is_a_link_is_not_followed(tmp_path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    lock_path(tmp_path / "volume.h5").symlink_to(victim)
    refused(tmp_path / "volume.h5", "lock")
    assert victim.read_text() == "precious"
