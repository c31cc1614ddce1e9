"""Damaged and hostile files through the real command: each has its own verdict, one line, and bounds of time and memory."""

import os
import random
import shutil
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from corpus import checkpoints, hdf5_files, imports, text_files
from corpus.case import Case
from corpus.good import write_good

from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.errors import PhyradgsError
from phyradgs_cl.importers import ImportOptions, import_scan
from phyradgs_cl.io import load_scanner
from phyradgs_cl.io.files import in_use_bytes
from phyradgs_cl.settings import read_config

SEED = 0
SECONDS, MEGABYTES = 10.0, 1000.0
# `make stress` sets STRESS: there all cases run, here some of every kind
STRESS = int(os.environ.get("STRESS", "1"))
LEAST, SOME, CHANGES = 1500, 220, 40 * STRESS
OLD = b"an older result"
pytestmark = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="the peak of memory as Linux counts it")


def all_cases(good: Path) -> Iterator[Case]:
    yield from hdf5_files.cases(good, SEED)
    yield from text_files.cases(SEED)
    yield from checkpoints.cases(good)
    yield from imports.cases()


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    return write_good(tmp_path_factory.mktemp("corpus") / "good", SEED)


def some_of(cases: list[Case]) -> list[Case]:
    """All cases, or some of every kind: the same ones for the same seed."""
    if STRESS > 1:
        return cases
    kinds: dict[str, list[Case]] = defaultdict(list)
    for case in cases:
        kinds[case.name.split(":")[0]].append(case)
    draw, share = random.Random(SEED), SOME / len(cases)
    return [c for kind in kinds.values() for c in draw.sample(kind, min(len(kind), max(3, round(share * len(kind)))))]


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def complaint(case: Case, good: Path, folder: Path, capfd: pytest.CaptureFixture[str]) -> str:
    """Runs the command of a case; returns what is wrong with its answer, or nothing."""
    file = case.make(good, folder / "in")
    outputs = folder / "in" if case.beside else folder / "out"
    outputs.mkdir(exist_ok=True)
    out = outputs / ("existing.npy" if "npy" in case.command else "existing.h5")
    if case.beside:
        out = outputs / case.beside.removesuffix(".checkpoint.npz")
    else:
        out.write_bytes(OLD)
    before, began_s = contents(outputs), time.process_time()
    Path("/proc/self/clear_refs").write_text("5")  # the peak of memory counts from here
    held = in_use_bytes("VmHWM:")
    status = load_cli().run(case.arguments(good, file, out))
    megabytes, error = (in_use_bytes("VmHWM:") - held) / 2**20, capfd.readouterr().err
    if "Traceback" in error or list(folder.rglob("canary")):
        return "a defect, or something was executed"
    if not case.refused:
        return "" if status == 0 else "must be read"
    lines = [line for line in error.splitlines() if line.startswith("phyradgs: ")]  # warnings have no such beginning
    if status != 2 or len(lines) != 1:
        return f"must be refused in one line: {status}, {error}"
    if contents(outputs) != before:
        return "left something in the folder of the output"
    if time.process_time() - began_s > SECONDS or megabytes > MEGABYTES:
        return f"took too much: {megabytes} MB"
    return "" if all(word in error for word in case.words) else f"lacks {case.words}: {error}"


def test_there_are_enough_and_each_has_a_name_of_its_own(good) -> None:
    cases = list(all_cases(good))
    assert len(cases) >= LEAST and len({case.name for case in cases}) == len(cases)
    assert sum(case.refused for case in cases) > 0.8 * len(cases)


def test_every_file_gets_its_verdict(good, tmp_path, capfd) -> None:
    wrong = []
    for number, case in enumerate(some_of(list(all_cases(good)))):
        folder = tmp_path / str(number)
        if said := complaint(case, good, folder, capfd):
            wrong.append(f"{case.name}: {said}")
        shutil.rmtree(folder)
    assert not wrong, "\n".join(wrong)


REAL = ImportOptions(pixel_size_mm=(3.0, 2.5))
# name: (good file or folder, the file in it whose bytes are changed, its reader)
READERS = {
    "scanner": ("scanner.toml", "", lambda path: load_scanner(path, Path("/nowhere"))),
    "configuration": ("run.toml", "", read_config),
    "r2, JSON": ("r2", "meta_data.json", lambda path: import_scan(path, None, "r2")),
    "r2, npy": ("r2", "proj_train/0000.npy", lambda path: import_scan(path, None, "r2")),
    "real": ("real", "geometric_motion_rs.json", lambda path: import_scan(path, REAL, "phyradgs-real")),
    "rtk, XML": ("rtk", "geometry.xml", lambda path: import_scan(path, None, "rtk")),
    "rtk, MHA": ("rtk", "projections.mha", lambda path: import_scan(path, None, "rtk")),
    "tiff, TIFF": ("tiff", "proj_1.tif", lambda path: import_scan(path, None, "tiff")),
    "tiff, TOML": ("tiff", "scan.toml", lambda path: import_scan(path, None, "tiff")),
    "naf": ("chest.pickle", "", lambda path: import_scan(path, None, "naf")),
}


@pytest.mark.filterwarnings("ignore")  # of NumPy about casts of absurd numbers
@pytest.mark.parametrize("name", READERS)
def test_changed_bytes_are_a_value_or_one_error(good, tmp_path, name) -> None:
    """HDF5 files are left out: the library itself crashes on some damaged headers."""
    of, inside, read = READERS[name]
    draw = random.Random(name)
    path = tmp_path / of
    (shutil.copytree if (good / of).is_dir() else shutil.copy)(good / of, path)
    file = path / inside if inside else path
    content = file.read_bytes()
    read(path)
    for _ in range(CHANGES):
        new = bytearray(content)
        for _ in range(draw.randint(1, 6)):
            at = draw.randrange(min(len(new), draw.choice((2048, len(new)))))
            pieces = (b"", draw.randbytes(2), b"\xff" * 8, b"nan", b"1e400", b"9" * 30)
            new[at : at + draw.randint(0, 2)] = draw.choice(pieces)
        file.write_bytes(new)
        try:
            read(path)
        except PhyradgsError as error:
            assert "\n" not in str(error) and error.exit_code in (2, 6), new
