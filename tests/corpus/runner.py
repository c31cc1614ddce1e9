"""Cases through the real command, in a process that is replaced when a file kills it."""

import json
import os
import select
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from corpus.case import Case

import phyradgs_cl

WATCHDOG_S = 120.0
OLD = b"an older result"


@dataclass(frozen=True)
class Outcome:
    """What one command came to; ``status`` is negative where its process was killed, by a signal or by us."""

    status: int
    error: str
    seconds: float
    megabytes: float
    left: tuple[str, ...]
    """What is in the output's folder afterwards that was not, is gone, or is another file than before."""

    @property
    def lines(self) -> list[str]:
        return [line for line in self.error.splitlines() if line.strip()]


class Runner:
    """A worker process, started anew after one that died or hung."""

    def __init__(self, work: str = "commands") -> None:
        self._work = work
        self._process: subprocess.Popen[str] | None = None
        self.asked = 0

    def run(self, case: Case, good: Path, folder: Path) -> Outcome:
        """One case, its file made in ``folder``, its output asked for beside an older one."""
        file = case.make(good, folder / "in")
        outputs = folder / "in" if case.beside else folder / "out"
        outputs.mkdir(exist_ok=True)
        out = outputs / _output_name(case)
        if not case.beside:
            out.write_bytes(OLD)
        before = _contents(outputs)
        answer = self.answer(case.arguments(good, file, out))
        if answer is None:
            status = -abs(self._process.wait())  # type: ignore[union-attr]
            answer = {"status": status, "error": "", "seconds": WATCHDOG_S, "megabytes": 0.0}
        after = _contents(outputs)
        changed = (str(name) for name in before.keys() | after.keys() if before.get(name) != after.get(name))
        return Outcome(**answer, left=tuple(sorted(changed)))

    def answer(self, question: object) -> dict[str, object] | None:
        """The worker's answer to any question; None where it died of it, or had to be ended."""
        process = self._alive()
        self.asked += 1
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(json.dumps(question) + "\n")
        process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], WATCHDOG_S)
        text = process.stdout.readline() if ready else ""
        if not text:
            process.kill()
            process.wait()
        return json.loads(text) if text else None

    def close(self) -> None:
        """Ends the worker: it has no more to read, and leaves by itself where it can."""
        if self._process is not None:
            self._process.stdin.close()  # type: ignore[union-attr]
            try:
                self._process.wait(timeout=30)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process.stdout.close()  # type: ignore[union-attr]

    def _alive(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            root = str(Path(phyradgs_cl.__file__ or phyradgs_cl.__path__[0]).resolve().parents[1])
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, *sys.path])}
            command = [sys.executable, str(Path(__file__).with_name("worker.py")), self._work]
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            self._process = subprocess.Popen(command, env=environment, **pipes)
        return self._process


def _output_name(case: Case) -> str:
    if case.beside:
        return case.beside.removesuffix(".checkpoint.npz")
    return "existing.npy" if "npy" in case.command else "existing.h5"


def _contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
