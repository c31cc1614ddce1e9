"""Damage to one object of an HDF5 file: every way in which a field may be missing, wrong, boundless or elsewhere."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

Damage = Callable[[Path], object]
Change = Callable[[h5py.File, str], object]


def on(address: str, change: Change) -> Damage:
    """The change of one object as damage of a file."""

    def damage(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file, address)

    return damage


def truncated(keep: float) -> Damage:
    """A file cut off after a share of its bytes."""
    return lambda path: path.write_bytes(path.read_bytes()[: int(path.stat().st_size * keep)])


def put(file: h5py.File, address: str, value: object = None, **how: object) -> h5py.Dataset:
    """Another dataset with the attributes of the old one."""
    attributes = dict(file[address].attrs)
    del file[address]
    made = file.create_dataset(address, data=value, **how)
    made.attrs.update(attributes)
    return made


def changed(change: Callable[[np.ndarray], object]) -> Change:
    return lambda file, address: put(file, address, change(np.asarray(file[address][()])))


def _first(value: float) -> Change:
    """One number of it, as float64 whatever it was."""

    def change(array: np.ndarray) -> np.ndarray:
        array = array.astype(np.float64)
        array.reshape(-1)[:1] = value
        return array

    return changed(change)


def _instead(make: Change) -> Change:
    """Something else at the address, or nothing."""

    def change(file: h5py.File, address: str) -> None:
        del file[address]
        make(file, address)

    return change


def _outside(file: h5py.File) -> Path:
    """A new file that is not in the folder of this one: an error may keep the last one open."""
    return Path(tempfile.mkdtemp(dir=Path(file.filename).parent.parent)) / "outside.h5"


def _external_link(file: h5py.File, address: str) -> None:
    """To a good dataset of the same name in a good file of another folder."""
    outside = _outside(file)
    with h5py.File(outside, "w") as other:
        file.copy(address, other, name="there")
    del file[address]
    file[address] = h5py.ExternalLink(f"../{outside.parent.name}/{outside.name}", "/there")


def _virtual(file: h5py.File, address: str) -> None:
    shape, attributes, outside = file[address].shape, dict(file[address].attrs), _outside(file)
    layout = h5py.VirtualLayout(shape, file[address].dtype)
    layout[...] = h5py.VirtualSource(outside, "there", shape)
    with h5py.File(outside, "w") as other:
        other["there"] = file[address][()]
    del file[address]
    file.create_virtual_dataset(address, layout).attrs.update(attributes)


def _stored_outside(file: h5py.File, address: str) -> None:
    values = np.atleast_1d(file[address][()])
    raw = Path(file.filename).with_suffix(".raw")
    values.tofile(raw)
    outside = [(str(raw), 0, h5py.h5f.UNLIMITED)]
    put(file, address, shape=values.shape, dtype=values.dtype, external=outside)


def _references(file: h5py.File, address: str) -> None:
    shape, root = file[address].shape, file["/"].ref
    put(file, address, np.full(shape, root, h5py.ref_dtype) if shape else root, dtype=h5py.ref_dtype)


def _huge(chunks: bool) -> Change:
    """Far more declared than stored, in the same number of axes."""

    def change(file: h5py.File, address: str) -> None:
        axes = max(file[address].ndim, 1)
        shape = (int(1e12 ** (1 / axes)),) * axes
        put(file, address, shape=shape, dtype="f8", chunks=(64,) * axes if chunks else None)

    return change


def _bomb(file: h5py.File, address: str) -> None:
    """128 MiB of zeros that deflate has shrunk to a thousandth."""
    axes = max(file[address].ndim, 1)
    shape = {1: (1 << 25,), 2: (1 << 12, 1 << 13), 3: (128, 512, 512)}[axes]
    chunks = {1: (1 << 18,), 2: (32, 1 << 13), 3: (1, 512, 512)}[axes]
    made = put(file, address, shape=shape, dtype="f4", chunks=chunks, compression="gzip", compression_opts=9)
    piece = np.zeros((1 << 22,) if axes == 1 else (512, 512) if axes == 3 else (512, 1 << 13), np.float32)
    for start in range(0, shape[0], len(piece) if axes < 3 else 1):
        made[start : start + len(piece) if axes < 3 else start + 1] = piece


def _many_times_one_text(file: h5py.File, address: str) -> None:
    """A hundred thousand entries that are all one text of a megabyte: 100 GB out of a file of 3 MB."""
    made = put(file, address, shape=(100_000,), dtype=h5py.string_dtype(), chunks=(100_000,))
    made[0] = "a" * (1 << 20)
    one = made.id.read_direct_chunk((0,))[1][:16]
    made.id.write_direct_chunk((0,), one * 100_000)


REMOVED = _instead(lambda file, address: None)
LINKS: dict[str, Change] = {
    "an external link": _external_link,
    "a loop of links": _instead(
        lambda f, a: (f.__setitem__(a, h5py.SoftLink("/loop")), f.__setitem__("/loop", h5py.SoftLink(a)))
    ),
    "a dangling link": _instead(lambda f, a: f.__setitem__(a, h5py.SoftLink("/nowhere"))),
}
FIELD: dict[str, Change] = {
    "removed": REMOVED,
    "misspelt": lambda f, a: f.move(a, f"{a}s"),
    "a group": _instead(lambda f, a: f.create_group(a)),
    "a text": lambda f, a: put(f, a, "text"),
    "texts": lambda f, a: put(f, a, ["a", "b"]),
    "an axis more": changed(lambda v: np.stack([v, v])),
    "nothing in it": changed(lambda v: np.zeros((0, *v.shape[1:]), v.dtype)),
    "complex": changed(lambda v: v.astype(np.complex64)),
    "a compound": changed(lambda v: np.zeros(v.shape, "f4,f4")),
    "null": lambda f, a: put(f, a, h5py.Empty("f8")),
    "references": _references,
    "NaN": _first(np.nan),
    "infinite": _first(np.inf),
    "minus infinite": _first(-np.inf),
    "extreme": _first(1e300),
    "minus extreme": _first(-1e300),
    **LINKS,
    "virtual": _virtual,
    "stored outside": _stored_outside,
    "declared huge": _huge(False),
    "declared huge in chunks": _huge(True),
}
_OF_TEXTS = ("removed", "a group", "texts", "null", "an external link", "a loop of links", "virtual")
TEXT: dict[str, Change] = {
    **{name: FIELD[name] for name in _OF_TEXTS},
    "a number": lambda f, a: put(f, a, 3.5),
    "another word": lambda f, a: put(f, a, "whatever"),
    "not UTF-8": lambda f, a: put(f, a, np.bytes_(b"\xff\xfe\xfd")),
    "one text many times": _many_times_one_text,
}
_dataset = _instead(lambda file, address: file.__setitem__(address, 1.0))
GROUP: dict[str, Change] = {"removed": REMOVED, "a dataset": _dataset, **LINKS}
BOMB: Change = _bomb


def value(new: object) -> Change:
    """Another value altogether."""
    return lambda file, address: put(file, address, new)


def attribute(name: str, value: object) -> Change:
    """One attribute of an object."""
    return lambda file, address: file[address].attrs.__setitem__(name, value)
