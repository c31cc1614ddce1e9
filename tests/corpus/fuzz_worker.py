"""Reads files with the readers of ``readers``, in a process that may die: JSON lines [reader, path] in, the outcome out."""

from __future__ import annotations

import json
import logging
import os
import sys
import traceback
import warnings
from pathlib import Path

from corpus.readers import READERS
from corpus.worker import cpu_s, peak_megabytes, reset_peak

from phyradgs_cl.errors import PhyradgsError


def outcome(name: str, path: Path) -> str:
    """ "value", "refused", or what else came of it."""
    try:
        READERS[name].read(path)
    except PhyradgsError as error:
        text = str(error)
        return "refused" if "\n" not in text and 0 < len(text) < 2000 and error.exit_code in (2, 6) else text
    except Exception:
        return traceback.format_exc()
    return "value"


def main() -> None:
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    for line in sys.stdin:
        name, path = json.loads(line)
        reset_peak()
        before_s = cpu_s()
        said = outcome(name, Path(path))
        answers.write(json.dumps([said, cpu_s() - before_s, peak_megabytes()]) + "\n")


if __name__ == "__main__":
    main()
