"""Runtimes and random clouds for all rooms; ``tolerances`` and the benchmarks' ``tables`` can be imported."""

import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pytest

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "benchmarks")]

if "PYTEST_XDIST_WORKER" in os.environ:  # a process per core: each has one thread, as what it starts has
    for threads in ("POCL_MAX_PTHREAD_COUNT", "OPENBLAS_NUM_THREADS"):  # before NumPy loads OpenBLAS, whose threads spin
        os.environ.setdefault(threads, "1")

import numpy as np  # noqa: E402
from guarded import guard  # noqa: E402
from stress import STRESSED  # noqa: E402

from phyradgs_cl.__main__ import load_cli  # noqa: E402
from phyradgs_cl.acquisition import ConeGeometry  # noqa: E402
from phyradgs_cl.acquisition.time_cells import TimeCells  # noqa: E402
from phyradgs_cl.api import save_scan, simulate  # noqa: E402
from phyradgs_cl.runtime import Runtime  # noqa: E402

collect_ignore = [] if find_spec("cil") else ["test_cil.py"]
Cloud = Callable[..., np.ndarray]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--gpu-shape", action="store_true", help="drive every device of this process as a GPU is driven")
    parser.addoption("--guarded", action="store_true", help="fail where a kernel writes beside its buffers")


def pytest_configure(config: pytest.Config) -> None:
    if any(".py" in word for word in config.args) and config.getoption("markexpr") == "not slow":
        config.option.markexpr = ""  # who names a file or a test wants it
    if config.getoption("--guarded"):
        guard()
    if config.getoption("--gpu-shape"):
        own, shape = Runtime.__init__, {"lanes": 1, "pixel_items": True}
        Runtime.__init__ = lambda *args, **given: own(*args, **(given if "lanes" in given else shape | given))  # type: ignore


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files of this folder go first: their tests are the longest, and one that starts last leaves other processes idle."""
    items.sort(key=lambda item: item.path.parent != HERE)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leaves out files whose tests are all slow: every process of a run imports what it collects."""
    if config.getoption("markexpr") != "not slow" or collection_path.suffix != ".py":
        return None
    text = collection_path.read_text(encoding="utf-8")
    return True if re.search(r"^pytestmark = \[?pytest\.mark\.slow", text, re.M) else None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Iterator[None]:
    """Workers send what a test has printed as UTF-8, which not every name of a file is."""
    report = yield
    report.sections = [(title, said.encode(errors="backslashreplace").decode()) for title, said in report.sections]
    return report


@pytest.fixture(autouse=True)
def ctrl_c_raises() -> Iterator[None]:
    """A test run started in the background would ignore the signal, and hand that on to its children."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def rt() -> Runtime:
    """The device that the package would choose, as it would drive it."""
    return Runtime()


@pytest.fixture(scope="session")
def banded_rt() -> Runtime:
    """As a CPU is driven, whatever ``--gpu-shape`` says."""
    return Runtime(lanes=8, pixel_items=False)


BUILDS = {"own lanes": {}, "work-items as lanes": {"lanes": 1, "pixel_items": True}}
OTHER_BUILDS = {"lanes 1": {"lanes": 1}, "float pairs": {"fp64": False}} if STRESSED else {}
"""Rarely wrong alone: otherwise tests/test_device_check.py alone asks every kernel so, in one build."""


@pytest.fixture(scope="session", params=BUILDS.values(), ids=BUILDS)
def two_rt(request: pytest.FixtureRequest) -> Runtime:
    """As a CPU is driven and as a GPU is."""
    return Runtime(**request.param)


ALL_BUILDS = BUILDS | OTHER_BUILDS


@pytest.fixture(scope="session", params=ALL_BUILDS.values(), ids=ALL_BUILDS)
def any_rt(request: pytest.FixtureRequest) -> Runtime:
    """Under ``make stress`` scalars and no float64 too: for a test or two of each kernel."""
    return Runtime(**request.param)


@pytest.fixture(scope="session")
def cli() -> ModuleType:
    """The command line in this process: cli.run([...]) gives the exit status."""
    return load_cli()


@pytest.fixture
def refused(cli, capfd) -> Callable[..., str]:
    """(words of a command, what its line must have..., status) → the one line in which it is refused."""

    def refuse(words: Sequence[object], *parts: str, status: int = 2) -> str:
        capfd.readouterr()
        assert cli.run([str(word) for word in words]) == status, words
        line = capfd.readouterr().err
        assert line.startswith("phyradgs: ") and line.count("\n") == 1, (words, line)
        assert "Value error" not in line, line
        assert all(part in line for part in parts), (words, line)
        return line

    return refuse


@pytest.fixture
def fast_pictures(monkeypatch) -> None:
    """`evaluate` draws nothing: a figure of nine panels takes a second, and tests/metrics looks at one."""
    monkeypatch.setattr("phyradgs_cl.workflow.volumes.slices_png", lambda path, *_: Path(path).write_bytes(b"\x89PNG"))


@pytest.fixture(scope="session")
def simulated(cli, tmp_path_factory) -> Callable[..., Path]:
    """(words of ``phyradgs simulate``...) → the scan, made once and not to be written to."""

    @cache
    def make(*words: str) -> Path:
        path = tmp_path_factory.mktemp("scan") / "scan.h5"
        assert cli.run(["simulate", *words, "-o", str(path)]) == 0
        return path

    return make


@pytest.fixture(scope="session")
def tiny_scan(rt: Runtime, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of 10³ voxels with its truth, for runs of a moment."""
    path = tmp_path_factory.mktemp("tiny") / "tiny.h5"
    save_scan(path, simulate("jaw", size=10, detector=12, views=4, time_samples=2, device=rt))
    return path


@pytest.fixture(scope="session")
def make_cloud() -> Cloud:
    """A factory of parameter rows (11, G) float64: random centres, axes, turns and densities.

    Numbers are rounded to float32, so that kernels and float64 oracles see the same cloud.
    """

    def make(count: int, seed: int = 0, *, spread: float = 0.6, scale: tuple[float, float] = (0.05, 0.2)) -> np.ndarray:
        rng = np.random.default_rng(seed)
        quaternion = rng.normal(size=(4, count))
        parts = [
            rng.uniform(-spread, spread, (3, count)), np.exp(rng.uniform(*np.log(scale), (3, count))),
            quaternion / np.linalg.norm(quaternion, axis=0), rng.uniform(0.5, 2.0, (1, count)),
        ]  # fmt: skip
        return np.concatenate(parts).astype(np.float32).astype(np.float64)

    return make


@pytest.fixture(scope="session")
def make_geometry() -> Callable[..., ConeGeometry]:
    """A factory of cones whose detector sees a volume of side 2 from a distance of 5."""

    def make(rows: int, columns: int, *, offset: tuple[float, float] = (0.0, 0.0)) -> ConeGeometry:
        return ConeGeometry(5.0, 7.5, (rows, columns), (3.9 / rows, 4.1 / columns), offset)

    return make


@pytest.fixture(scope="session")
def one_cell() -> Callable[..., TimeCells]:
    """A factory of tables with a single pose (12,) for the whole frame."""

    def make(pose: np.ndarray, lines: int, axis: str = "rows") -> TimeCells:
        one = np.ones(1)
        first, last = np.zeros(1, np.int32), np.full(1, lines, np.int32)
        return TimeCells(np.asarray(pose).reshape(1, 12), 0 * one, first, last, one, lines, axis)

    return make


@pytest.fixture(scope="session")
def finite_differences() -> Callable[..., np.ndarray]:
    """Central differences (shape of ``at``) of a scalar function, one entry after the other."""

    def differentiate(function: Callable[[np.ndarray], float], at: np.ndarray, step: float = 1e-6) -> np.ndarray:
        gradient = np.zeros(at.shape)
        for index in np.ndindex(*at.shape):
            ends = []
            for sign in (1, -1):
                moved = at.copy()
                moved[index] += sign * step
                ends.append(function(moved))
            gradient[index] = (ends[0] - ends[1]) / (2 * step)
        return gradient

    return differentiate
