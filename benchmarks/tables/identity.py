"""Keeps results of different objects apart that have the same name."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from phyradgs_cl.errors import InputError
from tables.results import Line

_CHUNK_BYTES = 1 << 20


def content_hash(source: Path | None) -> str | None:
    """Returns the BLAKE2b hash of a file's bytes, 16 hexadecimal digits. None for anything but a readable regular file."""
    if source is None or not source.is_file():
        return None
    digest = hashlib.blake2b(digest_size=8)
    try:
        with open(source, "rb") as file:
            while chunk := file.read(_CHUNK_BYTES):
                digest.update(chunk)
    except OSError:  # the check of the volumes says why
        return None
    return digest.hexdigest()


def refuse_other_objects(
    results: Path, planned: Sequence[Mapping[str, object]], lines: Sequence[Line]
) -> None:
    """Raises InputError where lines of a planned volume, at its size, are of another file or of other contents.

    Lines of early versions have no hash: for these the file's name is compared."""
    now = {_name(facts): facts for facts in planned}
    for line in lines:
        facts = now.get(_name(line))
        if facts is None or "error" in line:
            continue
        if line.get("source") != facts["source"]:
            found = f"runs of {line.get('source')} under the name {line['volume']!r}, which is {facts['source']} now"
        elif (line.get("source_hash") or facts["source_hash"]) != facts["source_hash"]:
            found = f"runs of {facts['source']} from before its contents changed"
        else:
            continue
        raise InputError(str(results), found, "one object per name", "choose another -o or rename the volume")


def _name(facts: Mapping[str, object]) -> tuple[object, ...]:
    return facts.get("study"), facts.get("volume"), facts.get("voxels")
