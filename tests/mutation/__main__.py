"""Mutation testing of a room: python -m tests.mutation ROOM [--count N] [--seed N].

Changes a copy of the sources in one place after the other and runs the room's tests, which are to fail. One line per
mutant on standard output; docs/results/tests.md has a verdict on those that live. POSIX only: a test run is a fork of a
process that has imported everything else already.
"""

import argparse
import importlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mutation.mutants import Mutant, mutants  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
NEEDED = ("phyradgs_cl", "cl", "data", "docs", "tests", "cli.py", "pyproject.toml")
IMPORTED = [
    "numpy", "scipy.ndimage", "scipy.spatial", "h5py", "skimage.metrics", "pyopencl", "hypothesis", "pytest",
]
TESTS = {
    "acquisition": ("tests/acquisition",),
    "objective": ("tests/objective",),
    # the optimiser's chain rule is tested with the terms that it adds
    "optim": ("tests/optim", "tests/objective/test_parameter_terms.py"),
}


def main() -> int:
    options = _arguments()
    for name in IMPORTED:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        for name in NEEDED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, tree / name)
        started = time.monotonic()
        if _outcome(tree, options.room, 600) != "lives":
            print("the tests fail without any mutant", file=sys.stderr)
            return 1
        limit_s = int(3 * (time.monotonic() - started) + 10)
        sys.dont_write_bytecode = True  # two mutants of one size in one second would share their bytecode
        shutil.rmtree(tree / "phyradgs_cl" / options.room / "__pycache__", ignore_errors=True)
        counts = {"killed": 0, "lives": 0, "too long": 0}
        for path, mutant in _drawn(options):
            counts[_tried(tree, options.room, path, mutant, limit_s)] += 1
    print(f"{options.room}: " + ", ".join(f"{count} {what}" for what, count in counts.items()))
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("room", choices=TESTS)
    parser.add_argument("--count", type=int, help="number of mutants to draw")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def _drawn(options: argparse.Namespace) -> list[tuple[Path, Mutant]]:
    every = [
        (path.relative_to(ROOT), mutant)
        for path in sorted((ROOT / "phyradgs_cl" / options.room).glob("*.py"))
        if path.name != "plot.py"  # figures: tests/api looks at them
        for mutant in mutants(path.read_bytes())
    ]
    chosen = every
    if options.count is not None and options.count < len(every):
        drawn = random.Random(options.seed).sample(every, options.count)
        chosen = sorted(drawn, key=lambda one: (one[0], one[1].start))
    print(f"{options.room}: {len(every)} mutants, {len(chosen)} tried", flush=True)
    return chosen


def _tried(tree: Path, room: str, path: Path, mutant: Mutant, limit_s: int) -> str:
    source = (ROOT / path).read_bytes()
    (tree / path).write_bytes(mutant.applied(source))
    try:
        outcome = _outcome(tree, room, limit_s)
    finally:
        (tree / path).write_bytes(source)
    print(f"{outcome}: {path}:{mutant}", flush=True)
    return outcome


def _outcome(tree: Path, room: str, limit_s: int) -> str:
    child = os.fork()
    if child == 0:
        _run_tests(tree, room, limit_s)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        return "too long" if os.WTERMSIG(status) == signal.SIGALRM else "killed"
    return "lives" if os.WEXITSTATUS(status) == 0 else "killed"


def _run_tests(tree: Path, room: str, limit_s: int) -> None:
    """The room's tests in this process, which ends with their status, or at the alarm."""
    import pytest

    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    os.setsid()
    signal.alarm(limit_s)
    os.chdir(tree)
    # this package's own folders give way to the copy's
    sys.path[:] = [str(tree), str(tree / "tests"), *(p for p in sys.path if not p.startswith(str(ROOT)))]
    for name in [name for name in sys.modules if name.split(".")[0] in ("phyradgs_cl", "mutation", "tests")]:
        del sys.modules[name]
    status = pytest.main(["-x", "-q", "-p", "no:cacheprovider", *TESTS[room]])
    os._exit(int(status))


if __name__ == "__main__":
    sys.exit(main())
