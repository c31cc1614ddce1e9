"""Regular files by patterns, within bounds: a pattern such as /**/* would otherwise look at all of a machine."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from phyradgs_cl.errors import InputError

_WILD = frozenset("*?[")


@dataclass
class Search:
    """Looks at ``most`` entries of folders, and no deeper than ``deepest`` of them; links to folders only where named."""

    subject: str
    most: int = 100_000
    deepest: int = 16

    def files(self, pattern: str, start: Path) -> list[Path]:
        """The regular files that match, sorted; ** stands for any folders, and a name without wildcards for itself."""
        parts = Path(pattern).parts
        root = start
        while parts and (os.path.isabs(parts[0]) or (len(parts) > 1 and not _WILD & set(parts[0]))):
            root, parts = root / parts[0], parts[1:]
        if parts and not _WILD & set(parts[0]):
            return [path] if os.path.lexists(path := root / parts[0]) else []
        found = dict.fromkeys(self._matches(root, parts, 0))  # ** finds some twice
        return sorted(found)

    def _matches(self, folder: Path, parts: Sequence[str], depth: int) -> Iterator[Path]:
        if not parts or depth > self.deepest:
            return
        first, rest = parts[0], parts[1:]
        if first == "**":
            yield from self._matches(folder, rest or ("*",), depth)
        for entry in self._entries(folder):
            is_named = fnmatchcase(entry.name, first) and (first[0] == "." or entry.name[0] != ".")
            path = folder / entry.name
            try:
                if first == "**" and entry.name[0] != "." and entry.is_dir(follow_symlinks=False):
                    yield from self._matches(path, parts, depth + 1)
                elif first != "**" and rest and is_named and entry.is_dir():
                    yield from self._matches(path, rest, depth + 1)
                elif first != "**" and not rest and is_named and entry.is_file():
                    yield path
            except OSError:  # gone since
                continue

    def _entries(self, folder: Path) -> list[os.DirEntry[str]]:
        found: list[os.DirEntry[str]] = []
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    self.most -= 1
                    if self.most < 0:
                        remedy = "name the folders of the scans"
                        raise InputError(self.subject, "a pattern that covers too many files", "fewer", remedy)
                    found.append(entry)
        except OSError:  # no folder, or one that cannot be read
            return []
        return found
