"""The hash that ties a result to the file that it came from."""

import hashlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from phyradgs_cl.io.regular import open_regular

_BLOCK_BYTES = 1 << 20


def sha256_of(path: str | Path, given_up: threading.Event | None = None) -> str:
    """SHA-256 of a file's bytes as 64 hexadecimal digits; InputError if it cannot be read."""
    digest = hashlib.sha256()
    with open_regular(Path(path), str(path), "a readable file") as (file, left):
        while left > 0 and not (given_up and given_up.is_set()) and (block := file.read(_BLOCK_BYTES)):
            digest.update(block[:left])
            left -= len(block)
    return digest.hexdigest()


@contextmanager
def hashing(path: str | Path) -> Iterator[Callable[[], str]]:
    """SHA-256 of the file that the body reads, at the same time: a disk gives its bytes once."""
    given_up = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        try:
            yield pool.submit(sha256_of, path, given_up).result
        finally:
            given_up.set()
