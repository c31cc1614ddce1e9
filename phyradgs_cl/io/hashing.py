"""The hash that ties a result to the file that it came from."""

from __future__ import annotations

import hashlib
from pathlib import Path

from phyradgs_cl.errors import InputError

_BLOCK_BYTES = 1 << 20


def sha256_of(path: str | Path) -> str:
    """SHA-256 of a file's bytes as 64 hexadecimal digits; InputError if it cannot be read."""
    digest = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            while block := file.read(_BLOCK_BYTES):
                digest.update(block)
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from error
    return digest.hexdigest()
