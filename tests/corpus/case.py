"""A damaged or hostile file, the command that it is given to, and what must come of it."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Damage = Callable[[Path], object]


@dataclass(frozen=True)
class Case:
    """One file: made by copying the good file ``of`` and damaging the copy.

    ``command`` has {file}, {good} and {out} in place of paths. ``refused`` is the verdict on this file: one line and
    status 2, or read as if nothing were wrong. ``words`` must be in the line.
    """

    name: str
    of: str
    damage: Damage
    command: tuple[str, ...]
    refused: bool = True
    words: tuple[str, ...] = ()
    beside: str = ""
    """A name that the file must have in the output's folder instead of being named itself: a checkpoint."""

    def make(self, good: Path, folder: Path) -> Path:
        """The damaged copy in ``folder``, which is new."""
        folder.mkdir(parents=True)
        source = good / self.of
        path = folder / (self.beside or source.name)
        (shutil.copytree if source.is_dir() else shutil.copy)(source, path)
        self.damage(path)
        return path

    def arguments(self, good: Path, file: Path, out: Path) -> list[str]:
        """The command line."""
        return [word.format(file=file, good=good, out=out) for word in self.command]


def truncated(keep: float) -> Damage:
    """A file cut off after a share of its bytes."""

    def damage(path: Path) -> None:
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * keep)])

    return damage


def filled(data: bytes) -> Damage:
    """Other content altogether."""
    return lambda path: path.write_bytes(data)


def replaced_text(old: str, new: str) -> Damage:
    """A piece of a text file exchanged."""

    def damage(path: Path) -> None:
        text = path.read_text()
        assert old in text, old
        path.write_text(text.replace(old, new, 1))

    return damage
