"""Every reader on files that are cut off, with changed bytes, and with values of other types: a value, or one error.

`make stress` sets STRESS, by which the numbers of files are multiplied: without it a few of each."""

import random
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
import writers_of_importers as w
from damage import changed, put, removed, value
from stress import STRESSED, TIMES

from phyradgs_cl.errors import PhyradgsError
from phyradgs_cl.exporters.writers import write_zarr
from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.importers import ImportOptions, import_scan, load_beads, load_volume
from phyradgs_cl.importers.angles import read_angles_rad
from phyradgs_cl.io import Volume, load_scanner, write_scan, write_volume
from phyradgs_cl.settings import read_settings
from phyradgs_cl.workflow import load_scan

pytestmark = pytest.mark.slow
OPTIONS = {
    "phyradgs-real": ImportOptions(pixel_size_mm=(3.0, 2.5)),
    "data-exchange": ImportOptions(source_to_axis_mm=500.0, source_to_detector_mm=800.0),
}
VALUES = np.random.default_rng(0).normal(size=(5, 6, 7)).astype(np.float32)
GRID = Grid(VALUES.shape, (1.0, 1.0, 1.0))
CLOUD = Gaussians(VALUES[:, 0, :3], np.ones((5, 3)), np.tile([1.0, 0, 0, 0], (5, 1)), np.ones(5))
IMAGE = sitk.GetImageFromArray(VALUES)
BEADS = "attenuation_per_mm = 0.5\n[[bead]]\ncentre_mm = [1, 2, 3]\nradius_mm = 0.4\n"
CONFIG = "method = 'phyradgs'\nstrips = 2\ntv_weight = 0.02\n[rates]\nposition = [2e-4, 2e-5]\n[control]\nevery = 100\n"
CARM = Path(__file__).parents[2] / "data" / "carm.toml"
WRITERS: dict[str, tuple[Callable[[Path, Any], object], Callable[[Path], object]]] = {
    "scan.h5": (lambda path, truth: write_scan(path, truth(fly=True).scan), load_scan),
    "volume.h5": (lambda path, _: write_volume(path, VALUES, GRID, {"seed": 1}, gaussians=CLOUD), load_volume),
    "bare.h5": (lambda path, _: h5py.File(path, "w").create_dataset("volume", data=VALUES).file.close(), load_volume),
    **{
        name: (lambda path, _: sitk.WriteImage(IMAGE, str(path), useCompression="packed" in path.name), load_volume)
        for name in ("v.nii", "v.nii.gz", "v.nrrd", "packed.nrrd", "v.mha", "packed.mha")
    },
    "v.tif": (lambda path, _: tifffile.imwrite(path, VALUES, imagej=True, metadata={"axes": "ZYX"}), load_volume),
    "packed.tif": (lambda path, _: tifffile.imwrite(path, VALUES, compression="zlib"), load_volume),
    "v.npy": (lambda path, _: np.save(path, VALUES), load_volume),
    "v.ome.zarr": (lambda path, _: write_zarr(path, Volume(VALUES, GRID), None), load_volume),
    "scanner.toml": (lambda path, _: path.write_bytes(CARM.read_bytes()), lambda path: load_scanner(path, Path("/nowhere"))),
    "configuration.toml": (lambda path, _: path.write_text(CONFIG), lambda path: read_settings(path, {})),
    "beads.toml": (lambda path, _: path.write_text(BEADS), load_beads),
    "angles.txt": (lambda path, _: path.write_text("angle (deg)\n0\n1,5\n3\n4,5\n"), lambda path: read_angles_rad(path, 4)),
}  # fmt: skip
HDF5 = (".h5", ".nxs")
TEXTS, IMAGES = (".json", ".toml", ".xml", ".xtekct", ".log", ".txt"), (".mha", ".nrrd", ".nii", ".gz")
WORDS = (b"word", b'"word"', b"", b"-1", b"0", b"nan", b"1e400", b"9" * 30, b"[]", b"null", b"0.5", b"1000000000")
# HDF5 and SimpleITK crash on some changed bytes of headers: there, objects are changed, or what comes behind the header
CHANGES = {
    "removed": removed, "a text": value("text"), "texts": value(["a", "b"]), "a number": value(3.5), "1e300": value(1e300),
    "an axis more": changed(lambda v: np.stack([v, v])), "an axis less": changed(lambda v: v[0] if v.ndim else v),
    "nothing in it": changed(lambda v: np.zeros((0, *v.shape[1:]))), "NaN": changed(lambda v: np.full(v.shape, np.nan)),
    "complex": changed(lambda v: np.ones(v.shape, complex)), "zeros": changed(lambda v: np.zeros(v.shape)),
    "null": value(h5py.Empty("f8")), "huge": lambda f, a: put(f, a, shape=(10**4,) * 3, dtype="f8", chunks=(64,) * 3),
    "a link to nowhere": lambda f, a: (f.pop(a), f.__setitem__(a, h5py.SoftLink("/nowhere"))),
    "another file": lambda f, a: (f.pop(a), f.__setitem__(a, h5py.ExternalLink("/etc/passwd", "/"))),
    "in a circle": lambda f, a: (f.pop(a), f.__setitem__(a, h5py.SoftLink(a))),
    "another unit": lambda f, a: f[a].attrs.__setitem__("units", "furlong"),
}  # fmt: skip
WRONG = ("nothing in it", "NaN", "complex", "null", "a link to nowhere", "another file", "in a circle")
"""Changes that no dataset survives without which a file is refused."""


def good(name: str, folder: Path, make_truth: Any) -> tuple[list[Path], Callable[[], object]]:
    """The files of a reader, one of each kind, and the function that reads them."""
    if name in w.WRITERS:
        path, read = w.write(name, folder, make_truth), partial(import_scan, options=OPTIONS.get(name), form=name)
    else:
        WRITERS[name][0](path := folder / name, make_truth)
        read = WRITERS[name][1]
    files = [file for file in sorted(path.rglob("*")) if file.is_file()] or [path]
    return list({(file.suffix, file.name[:4], len(file.parts)): file for file in files}.values()), partial(read, path)


def answered(read: Callable[[], object], told: object) -> bool:
    """Whether a damaged file is read; if not, one error of one line says so."""
    try:
        read()
    except PhyradgsError as error:
        assert "\n" not in str(error) and len(str(error)) < 1500 and error.exit_code in (2, 6), (told, error)
        return False
    return True


def changed_objects(file: Path, read: Callable[[], object], draw: random.Random) -> Iterator[tuple[str, bool]]:
    """Changes one object of an HDF5 file after the other."""
    content, addresses = file.read_bytes(), []
    with h5py.File(file) as opened:
        opened.visit(addresses.append)
    for address in addresses:
        is_needed, drawn = False, draw.sample(sorted(CHANGES), min(len(CHANGES), TIMES))
        for change in ("removed", *drawn):
            file.write_bytes(content)
            with h5py.File(file, "r+") as opened:
                is_number = isinstance(opened[address], h5py.Dataset) and opened[address].dtype.kind in "iuf"
                try:
                    CHANGES[change](opened, address)
                except (TypeError, ValueError, AttributeError):  # no such change of a group, or of a text
                    continue
            yield f"{address}: {change}", is_needed and is_number and change in WRONG
            if change == "removed" and not {*drawn}.isdisjoint(WRONG):
                is_needed = is_needed or not answered(read, address)


def with_other_bytes(content: bytes, draw: random.Random, first: int) -> bytes:
    new = bytearray(content)
    for _ in range(draw.randint(1, 6)):
        at = first + draw.randrange(min(len(new) - first, draw.choice((2048, len(new)))))
        new[at : at + draw.randint(0, 2)] = draw.choice((b"", draw.randbytes(2), b"\xff" * 8, b"nan", b"9" * 30))
    return bytes(new)


def with_other_values(content: bytes, draw: random.Random, _: int) -> bytes:
    """A number of a text becomes something else."""
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?", content[: 1 << 14]))
    for one in sorted(draw.sample(numbers, min(len(numbers), draw.randint(1, 2))), key=lambda one: -one.start()):
        content = content[: one.start()] + draw.choice(WORDS) + content[one.end() :]
    return content


def damaged(file: Path, read: Callable[[], object], draw: random.Random) -> Iterator[tuple[str, bool]]:
    """Damages a file in one way after the other. Yields what was done, and whether a file that is read must be refused."""
    content = file.read_bytes()
    for _ in range(5 * TIMES if STRESSED else 2):
        share = draw.uniform(0.02, 0.98)
        file.write_bytes(content[: int(share * len(content))])
        yield f"cut off after {share:.3f}", share < 0.9 and file.suffix not in TEXTS
    if file.suffix in HDF5:
        file.write_bytes(content)
        yield from changed_objects(file, read, draw)
        return
    ways = [with_other_bytes, *([with_other_values] if file.suffix in TEXTS else [])]
    for way in ways:
        for _ in range(12 * TIMES if STRESSED else 5):
            file.write_bytes(new := way(content, draw, len(content) // 2 if file.suffix in IMAGES else 0))
            yield repr(new[:2000]), False
    file.write_bytes(content)


@pytest.mark.filterwarnings("ignore")  # of NumPy about casts of absurd numbers
@pytest.mark.parametrize("name", [*w.WRITERS, *WRITERS])
def test_a_damaged_file_is_a_value_or_one_error(tmp_path, make_truth, name) -> None:
    files, read = good(name, tmp_path, make_truth)
    assert answered(read, "the good file")
    for file in files:
        content = file.read_bytes()
        file.unlink()
        is_read = not answered(read, "a file that is missing")
        file.write_bytes(content)
        for told, must_be_refused in damaged(file, read, random.Random(f"{name} {file.name}")):
            assert not (answered(read, told) and must_be_refused and is_read), (file.name, told)
        file.write_bytes(content)
