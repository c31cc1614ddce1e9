"""The floors of the house: a room imports lower floors only, and pyopencl lives in one room.

Rooms on one floor do not see each other. Which room is on which floor says the table of docs/architecture.md; a new module
has to have a room there before the tests pass.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "phyradgs_cl"
NAME = PACKAGE.name

ARCHITECTURE = PACKAGE.parent / "docs" / "architecture.md"


def floors_of_the_page() -> dict[str, int]:
    """Every room with its floor, from the table of docs/architecture.md."""
    rows = re.findall(r"^\| (\d+) \| (.+?) \|", ARCHITECTURE.read_text(encoding="utf-8"), re.MULTILINE)
    found = [(name, int(floor)) for floor, cell in rows for name in re.findall(r"`(\w+)(?:\.py|/)?`", cell)]
    assert len(found) == len(dict(found)), "a room stands on two floors"
    return dict(found)


FLOOR_OF = {"__init__": 0, **floors_of_the_page()}
# Within floor 0: text knows nothing, errors are text, checks raise them.
GROUND_FLOOR = {
    "__init__": set(),
    "text": set(),
    "errors": {"text"},
    "checks": {"errors"},
    "resources": set(),
    "signals": set(),
}


def module_files() -> list[Path]:
    """Every module of the package, and cli.py beside it."""
    return [*sorted(PACKAGE.rglob("*.py")), PACKAGE.parent / "cli.py"]


def room_of(path: Path) -> str:
    """The room that a file belongs to: its folder in the package, or its own name."""
    if PACKAGE not in path.parents:
        return path.stem
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imported_modules(path: Path) -> Iterator[tuple[int, str]]:
    """(line, dotted name) of every import, those inside functions and type-checking blocks included."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: write the import with its full name"
            if node.module == NAME:
                yield from ((node.lineno, f"{NAME}.{alias.name}") for alias in node.names)
            elif node.module:
                yield node.lineno, node.module


def imported_rooms(path: Path) -> Iterator[tuple[int, str]]:
    """(line, room) of every import from this package; ``from phyradgs_cl import __version__`` is __init__."""
    for line, module in imported_modules(path):
        parts = module.split(".")
        if parts[0] != NAME:
            continue
        room = parts[1] if len(parts) > 1 else "__init__"
        yield line, "__init__" if room.startswith("__version") else room


def forbidden(room: str, other: str) -> bool:
    """Whether ``room`` may not import ``other``."""
    if room == other:
        return False
    if room in GROUND_FLOOR and other in GROUND_FLOOR:
        return other not in GROUND_FLOOR[room]
    return FLOOR_OF[other] >= FLOOR_OF[room]


@pytest.mark.parametrize("path", module_files(), ids=lambda p: str(p.relative_to(PACKAGE.parent)))
def test_a_module_imports_only_lower_floors(path: Path) -> None:
    room = room_of(path)
    assert room in FLOOR_OF, f"{path} belongs to no room of docs/architecture.md"
    for line, other in imported_rooms(path):
        assert other in FLOOR_OF, f"{path}:{line}: imports {other}, which is no room of docs/architecture.md"
        assert not forbidden(room, other), (
            f"{path}:{line}: {room} (floor {FLOOR_OF[room]}) imports {other} (floor {FLOOR_OF[other]})"
        )


def test_the_table_names_only_rooms_that_exist() -> None:
    found = {room_of(path) for path in module_files()}
    assert set(FLOOR_OF) <= found, f"no such room: {set(FLOOR_OF) - found}"


def test_the_page_is_read_as_it_is_meant() -> None:
    assert (
        FLOOR_OF["fields"] == FLOOR_OF["parallel"] == 1 and FLOOR_OF["cli"] == 8 and FLOOR_OF["__main__"] == 9
    )
    assert sorted(set(FLOOR_OF.values())) == list(range(10))


def test_the_rule_sees_upward_and_sideways_imports() -> None:
    assert forbidden("fields", "acquisition")
    assert forbidden("phantoms", "io")
    assert forbidden("errors", "checks")
    assert not forbidden("checks", "errors")
    assert not forbidden("reconstructors", "errors")


@pytest.mark.parametrize("path", module_files(), ids=lambda p: str(p.relative_to(PACKAGE.parent)))
def test_pyopencl_lives_in_the_runtime(path: Path) -> None:
    if room_of(path) != "runtime":
        found = [line for line, module in imported_modules(path) if module.split(".")[0] == "pyopencl"]
        assert not found, f"{path}:{found[0]}: only phyradgs_cl/runtime imports pyopencl"


@pytest.mark.parametrize("path", module_files(), ids=lambda p: str(p.relative_to(PACKAGE.parent)))
def test_pytorch_lives_in_the_neural_room(path: Path) -> None:
    if room_of(path) == "neural" or path == PACKAGE / "api" / "bridges.py":  # operators for PyTorch's users
        return
    found = [line for line, module in imported_modules(path) if module.split(".")[0] == "torch"]
    assert not found, f"{path}:{found[0]}: only phyradgs_cl/neural imports torch"


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_the_library_does_not_print(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        is_print = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
        assert not is_print, f"{path}:{node.lineno}: the library returns or raises; the command line prints"
