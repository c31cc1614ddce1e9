"""What an installation needs travels with it: kernels, data and command line, in a wheel as in a checkout."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from phyradgs_cl import resource

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).resolve().parent.parent
MOST_BYTES = 1_050_000  # kernels, code, the page's script and small files of numbers; nothing measured or rendered


PATTERNS = ("cl", "*.cl"), ("cl", "*.h"), ("data", "*.*")
FOUND = (path for folder, pattern in PATTERNS for path in (REPOSITORY / folder).rglob(pattern))
NEEDED = {"cli.py", *(path.relative_to(REPOSITORY).as_posix() for path in FOUND)}


def build(target: str, folder: Path) -> Path:
    """Build the wheel or sdist of this repository without any download."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = folder.iterdir()
    return built


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", tmp_path_factory.mktemp("wheel"))


def test_this_installation_finds_its_resources() -> None:
    assert {"cl/splat_forward.cl", "data/demo.toml"} < NEEDED and len(NEEDED) > 15
    for name in NEEDED:
        folder, _, rest = name.partition("/")
        assert (resource(folder) / rest).is_file(), name
    with pytest.raises(FileNotFoundError, match="nothing-here is missing"):
        resource("nothing-here")


def test_the_wheel_holds_what_the_package_reads(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        by_name = {name.rsplit("/", 1)[-1]: name for name in names if ".dist-info/" in name}
        assert "phyradgs = phyradgs_cl.__main__:main" in archive.read(by_name["entry_points.txt"]).decode()
        assert "Apache License" in archive.read(by_name["LICENSE"]).decode()
    assert {f"phyradgs_cl/{name}" for name in NEEDED} <= names
    files = (path for path in (REPOSITORY / "phyradgs_cl").rglob("*") if path.suffix in (".py", ".pyi", ".typed"))
    assert {path.relative_to(REPOSITORY).as_posix() for path in files} <= names
    assert all(name.startswith(("phyradgs_cl/", "phyradgs_cl-")) for name in names), "more than one package"
    assert not [name for name in names if "__pycache__" in name] and wheel.stat().st_size < MOST_BYTES


def test_the_wheel_runs_outside_the_repository(wheel: Path, tmp_path: Path) -> None:
    site, elsewhere = tmp_path / "site", tmp_path / "a folder with spaces"
    elsewhere.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    environment = {**os.environ, "PYTHONPATH": str(site)}
    for arguments, expected in (
        (["-c", "from phyradgs_cl import resource; print(resource('cl'))"], str(site)),
        (["-c", "from phyradgs_cl.runtime.opencl import kernel_source as s; print(s('rays'))"], "__kernel"),
        (["-m", "phyradgs_cl", "--help"], "reconstruct"),
    ):
        where = {"cwd": elsewhere, "env": environment, "timeout": 120}
        done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, **where)
        assert done.returncode == 0 and expected in done.stdout, done.stderr


def test_the_sdist_can_build_the_wheel(tmp_path: Path) -> None:
    with tarfile.open(build("sdist", tmp_path)) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    assert NEEDED | {"pyproject.toml", "LICENSE", "README.md", "phyradgs_cl/__init__.py"} <= names
