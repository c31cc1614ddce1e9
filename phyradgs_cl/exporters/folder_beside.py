"""Folders that are there whole or not at all: filled beside the target, then renamed."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from phyradgs_cl import signals
from phyradgs_cl.errors import OutputError
from phyradgs_cl.io.output import temporary_name


@contextmanager
def folder_written_beside(path: Path) -> Iterator[Path]:
    """Yield a new folder that becomes ``path`` on success, and of which nothing is left otherwise. A folder with
    something in it is never replaced: it could hold anything."""
    target = Path(os.path.abspath(path))
    if target.is_symlink() or (target.exists() and (not target.is_dir() or any(target.iterdir()))):
        raise OutputError(
            str(path), "something that is there already", "a new or an empty folder", "choose another name"
        )
    temporary = temporary_name(target)
    try:
        temporary.mkdir()
        yield temporary
        os.replace(temporary, target)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            found = error.strerror or str(error)
            raise OutputError(str(path), found, "a folder that can be written", "choose another") from error
        raise
    finally:
        signals.unfinished.discard(str(temporary))
