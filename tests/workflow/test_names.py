"""Names that no program's author thought of: bytes that are no UTF-8, as long as a file system allows, a NUL in a title."""

import os
import shutil
import sys
from pathlib import Path

import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.io import checkpoint_path, read_volume
from phyradgs_cl.io.output import beside, shortened
from phyradgs_cl.text import plain_text

linux = pytest.mark.skipif(sys.platform != "linux", reason="file systems that take any bytes")
pytestmark = [pytest.mark.slow, linux]
BAD = os.fsdecode(b"bad\xff")
FAST = ["--method", "sirt", "--iterations", "2"]


def test_text_is_made_fit_to_be_shown_and_names_beside_a_name_fit_a_file_system() -> None:
    assert plain_text("µ\tm\n\x1b[2J\0\udcff\x85") == "µ\tm\n\ufffd[2J\ufffd\ufffd\ufffd"
    assert str(InputError(f"{BAD}.h5", "a\x1b")) == "bad\ufffd.h5: found a\ufffd"
    for stem in ("v", "v" * 240, "v" * 255, "ü" * 120, BAD + "ü" * 100, "v" * 254 + "w"):
        names = {beside(f"folder/{stem}", ending).name for ending in (".checkpoint.npz", ".lock", ".error.txt")}
        assert len(names) == 3 and all(len(os.fsencode(name)) <= 255 for name in names)
    assert beside("a/v.h5", ".lock", ".") == Path("a/.v.h5.lock") and checkpoint_path("v.h5").name == "v.h5.checkpoint.npz"
    assert shortened("v" * 300, 80) != shortened("v" * 299 + "w", 80)


@pytest.mark.parametrize("stem", [BAD, "ä" * 126], ids=["bytes", "255"])
def test_a_scan_and_a_volume_of_that_name(tiny_scan, tmp_path, cli, stem, capfd) -> None:
    scan, output = tmp_path / f"{stem}.h5", tmp_path / "out" / f"{stem}.h5"
    output.parent.mkdir()
    shutil.copy(tiny_scan, scan)
    config, picture = (tmp_path / f"{stem[:100]}{suffix}" for suffix in (".toml", ".png"))
    config.write_text("iterations = 1\n")
    words = ["reconstruct", str(scan), *FAST, "--config", str(config), "-o", str(output)]
    assert cli.run([*words, "--preview", str(picture), "--checkpoint-every", "0.000001"]) == 0
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert cli.run(["info", str(output)]) == 0
    assert cli.run(["report", str(output), "-o", str(tmp_path / "page.html"), "--views", "0"]) == 0
    assert read_volume(output).provenance["scan"] == str(scan) and sorted(output.parent.iterdir()) == [output]
    assert "was not found" not in (tmp_path / "page.html").read_text() and "Traceback" not in capfd.readouterr().err
