"""Works through questions in a process that may die, and says what each cost: python worker.py commands|readers.

Each line in is a question in JSON: the words of a command, or [reader, path]; each line out is an answer. Standard
error is caught at its descriptor, so that libraries' own complaints count too. Seconds are the process's own, whatever
else the machine does.
"""

import json
import logging
import os
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.errors import PhyradgsError


def peak_megabytes() -> float:
    """Of resident memory, since Linux was told to count anew."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def reset_peak() -> None:
    """``peak_megabytes`` counts from now on."""
    Path("/proc/self/clear_refs").write_text("5")


def cpu_s() -> float:
    """Seconds of processor time of this process."""
    use = resource.getrusage(resource.RUSAGE_SELF)
    return use.ru_utime + use.ru_stime


def commanded(words: list[str]) -> dict[str, object]:
    """{status, error} of a command."""
    with tempfile.TemporaryFile() as caught:
        sys.stderr.flush()
        os.dup2(caught.fileno(), 2)
        try:
            status = load_cli().run(words)
        except BaseException:  # a defect: its traceback is the answer
            status = 1
            traceback.print_exc()
        logging.shutdown()
        sys.stderr.flush()
        caught.seek(0)
        return {"status": status, "error": caught.read().decode(errors="replace")}


def read(question: tuple[str, str]) -> dict[str, object]:
    """{said}: "value", "refused", or what else came of it."""
    from corpus.readers import READERS

    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    name, path = question
    try:
        READERS[name].read(Path(path))
    except PhyradgsError as error:
        text = str(error)
        is_fit = "\n" not in text and 0 < len(text) < 2000 and error.exit_code in (2, 6)
        return {"said": "refused" if is_fit else text}
    except Exception:
        return {"said": traceback.format_exc()}
    return {"said": "value"}


WORK: dict[str, Callable[..., dict[str, object]]] = {"commands": commanded, "readers": read}


def main() -> None:
    work, answers = WORK[sys.argv[1]], os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    for line in sys.stdin:
        reset_peak()
        before_s, before_wall_s = cpu_s(), time.monotonic()
        answer = work(json.loads(line))
        seconds = min(cpu_s() - before_s, time.monotonic() - before_wall_s)
        answers.write(json.dumps({**answer, "seconds": seconds, "megabytes": peak_megabytes()}) + "\n")


if __name__ == "__main__":
    main()
