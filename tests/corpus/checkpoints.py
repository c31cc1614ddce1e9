"""Checkpoints: archives that unfold, lie or execute, and arrays that no run has written."""

import io
import pickle
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from corpus.case import Case, Damage, filled, truncated
from corpus.good import RESUMED, resume_command

Arrays = dict[str, np.ndarray]
DEFLATED = zipfile.ZIP_DEFLATED


class Bomb:
    """Runs a shell command when it is unpickled by anything that runs what a pickle says."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        import os

        return os.system, ("touch canary",)


def rewritten(change: Callable[[Arrays], object]) -> Damage:
    """The same archive with other arrays."""

    def damage(path: Path) -> None:
        with np.load(path) as archive:
            arrays = dict(archive)
        change(arrays)
        with open(path, "wb") as file:
            np.savez(file, **arrays)

    return damage


def with_member(name: str, data: bytes, compression: int = zipfile.ZIP_STORED) -> Damage:
    """One member more, or another one of a name that is there."""

    def damage(path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            members = {n: archive.read(n) for n in archive.namelist() if n != name}
        with zipfile.ZipFile(path, "w") as archive:
            for other, content in members.items():
                archive.writestr(other, content)
            archive.writestr(name, data, compression)

    return damage


def header(shape: str, descr: str = "'<f4'", body: bytes = b"") -> bytes:
    """A .npy member that says what it likes."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + body


def _pickled() -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.array([Bomb()], object), allow_pickle=True)
    return buffer.getvalue()


def _doubled(path: Path) -> None:
    """Forty members that are all one: overlapping, as zip bombs do."""
    with zipfile.ZipFile(path) as archive:
        first = archive.infolist()[2]
        data = path.read_bytes()
    with zipfile.ZipFile(path, "a") as archive:
        for number in range(40):
            copy = zipfile.ZipInfo(f"again{number}.npy")
            copy.header_offset, copy.file_size = first.header_offset, first.file_size
            copy.compress_size, copy.CRC = first.compress_size, first.CRC
            archive.filelist.append(copy)
            archive.NameToInfo[copy.filename] = copy
        archive._didModify = True  # type: ignore[attr-defined]
    assert path.stat().st_size > len(data)


WHOLE: dict[str, Damage] = {
    "empty": filled(b""),
    "text": filled(b"no archive"),
    "a pickle": filled(pickle.dumps(Bomb())),
    "an empty archive": filled(b"PK\x05\x06" + b"\0" * 18),
    "a plain .npy": filled(header("(3,)", body=b"\0" * 12)),
    "objects": with_member("volume.npy", _pickled()),
    "objects beside": with_member("extra.npy", _pickled()),
    "an array declared huge": with_member("volume.npy", header("(1000000, 1000000)")),
    "an array declared negative": with_member("volume.npy", header("(-3, 8, 8)")),
    "a header that calls": with_member("volume.npy", header("__import__('os').system('touch canary')")),
    "a header too deep": with_member("volume.npy", header("(" * 5000)),
    "a member that is no array": with_member("readme.txt", b"hello"),
    "a member outside": with_member("../../evil.npy", header("(3,)", body=b"\0" * 12)),
    "a deflate bomb": with_member("volume.npy", header("(300000000,)", body=bytes(1 << 28)), DEFLATED),
    "overlapping members": _doubled,
    "another format": rewritten(lambda a: a.update(format=np.array(99))),
    "a format of text": rewritten(lambda a: a.update(format=np.array("one"))),
    "a format of many": rewritten(lambda a: a.update(format=np.ones(3, int))),
    "no format": rewritten(lambda a: a.pop("format")),
    "another run": rewritten(lambda a: a.update(run=np.array('{"seed": 7}'))),
    **{f"cut off after {keep}": truncated(keep) for keep in (0.1, 0.5, 0.9, 0.99)},
}


def _spoilt(name: str) -> Iterator[tuple[str, Damage]]:
    """One array of a state in every way."""
    yield "removed", rewritten(lambda a: a.pop(name))
    yield "text", rewritten(lambda a: a.update({name: np.array("text")}))
    yield "of another shape", rewritten(lambda a: a.update({name: np.stack([a[name]] * 2)}))
    yield "empty", rewritten(lambda a: a.update({name: a[name].reshape(-1)[:0]}))
    yield "complex", rewritten(lambda a: a.update({name: np.zeros(a[name].shape, complex)}))
    yield "truth values", rewritten(lambda a: a.update({name: np.zeros(a[name].shape, bool)}))


TEXTS = ("", "{}", "[", "[1]", '[{"iteration": "x"}]', "null", "[" * 50_000, '{"bit_generator": "MT19937"}')


def cases(good: Path) -> Iterator[Case]:
    """Of every method that keeps one."""
    for method in RESUMED:
        name = f"{method}.checkpoint.npz"
        with np.load(good / name) as archive:
            arrays = dict(archive)
        damages = WHOLE if method in ("sirt", "phyradgs") else {}
        for what, damage in damages.items():
            harmless = what == "a member outside"  # an array more, by whatever name: nothing is ever unpacked
            yield _case(method, what, damage, refused=not harmless)
        for array in sorted(set(arrays) - {"format"}):
            kind = arrays[array].dtype.kind
            for what, damage in _spoilt(array):
                harmless = array == "queue" and what == "empty"  # a new pass begins
                yield _case(method, f"{array} {what}", damage, refused=not harmless)
            if kind == "f" and arrays[array].size:
                for number in (np.nan, np.inf, -np.inf):
                    damage = rewritten(lambda a, n=array, v=number: a[n].reshape(-1).__setitem__(0, v))
                    yield _case(method, f"{array} with {number}", damage)
            if kind == "U":
                for text in TEXTS:
                    update = rewritten(lambda a, n=array, t=text: a.update({n: np.array(t)}))
                    yield _case(method, f"{array} {text[:20]!r}", update)
        for value in (-1, 10**6, 2**62):
            update = rewritten(lambda a, v=value: a.update(iteration=np.array(v)))
            yield _case(method, f"iteration {value}", update)
    for value in (-1, 4, 2**40):
        update = rewritten(lambda a, v=value: a.update(queue=np.array([v, 0])))
        yield _case("phyradgs", f"queue of {value}", update)


def _case(method: str, what: str, damage: Damage, refused: bool = True) -> Case:
    of, command = f"{method}.checkpoint.npz", resume_command(method)
    return Case(f"checkpoint of {method}: {what}", of, damage, command, refused, beside="v.h5.checkpoint.npz")
