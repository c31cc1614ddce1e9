"""The floors of the house: a room imports lower floors only, no imports go in a circle, and pyopencl lives in one room.

Rooms on one floor do not see each other. Which room is on which floor says the table of docs/architecture.md; a new module
has to have a room there before the tests pass.
"""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "phyradgs_cl"
NAME = PACKAGE.name
ARCHITECTURE = PACKAGE.parent / "docs" / "architecture.md"
MOST_FILES = 14  # of a folder, __init__.py among them, but for those that have a file per command or format
PER_ITEM = PACKAGE / "commands", PACKAGE / "importers" / "formats"


def floors_of_the_page() -> dict[str, int]:
    """Every room with its floor, from the table of docs/architecture.md."""
    rows = re.findall(r"^\| (\d+) \| (.+?) \|", ARCHITECTURE.read_text(encoding="utf-8"), re.MULTILINE)
    found = [(name, int(floor)) for floor, cell in rows for name in re.findall(r"`(\w+)(?:\.py|/)?`", cell)]
    assert len(found) == len(dict(found)), "a room stands on two floors"
    return dict(found)


FLOOR_OF = {"__init__": 0, **floors_of_the_page()}
# Within floor 0: text knows nothing, errors are text, checks and signals know errors.
GROUND_FLOOR = {name: set() for name in ("__init__", "text")}
GROUND_FLOOR |= {"errors": {"text"}, "checks": {"errors", "text"}, "signals": {"errors"}}
HOME = {"pyopencl": "runtime", "torch": "neural"}  # packages that one room alone imports


@cache
def modules() -> dict[Path, ast.Module]:
    """Every module of the package, and cli.py beside it, as a tree."""
    paths = [*sorted(PACKAGE.rglob("*.py")), PACKAGE.parent / "cli.py"]
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def room_of(path: Path) -> str:
    """The room that a file belongs to: its folder in the package, or its own name."""
    if PACKAGE not in path.parents:
        return path.stem
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def dotted(path: Path) -> str:
    """The name by which a module is imported."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def that_run(tree: ast.AST) -> Iterator[ast.AST]:
    """The nodes that ever run, in functions too: all but those for a type checker."""
    for node in ast.iter_child_nodes(tree):
        if not (isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"):
            yield node
            yield from that_run(node)


def imported_names(nodes: Iterator[ast.AST]) -> Iterator[tuple[int, str]]:
    """(line, dotted name) of every import among the nodes; ``from a import b`` is a.b."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "" if node.level else node.module  # a relative import is no name at all
            yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)


def forbidden(room: str, other: str) -> bool:
    """Whether ``room`` may not import ``other``."""
    if room == other:
        return False
    if room in GROUND_FLOOR and other in GROUND_FLOOR:
        return other not in GROUND_FLOOR[room]
    return FLOOR_OF[other] >= FLOOR_OF[room]


def complaint(room: str, name: str) -> str:
    """What is wrong with an import of ``name`` in ``room``; nothing where it may be."""
    first, _, rest = name.partition(".")
    other = rest.partition(".")[0]
    if not first:
        return "write the import with its full name"
    if first != NAME:
        return ""
    other = "__init__" if not other or other.startswith("__version") or name == f"{NAME}.resource" else other
    if other not in FLOOR_OF:
        return f"imports {other}, which is no room of docs/architecture.md"
    if forbidden(room, other):
        return f"{room} (floor {FLOOR_OF[room]}) imports {other} (floor {FLOOR_OF[other]})"
    return ""


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import each other, in a row that ends where it begins; none where there is an order."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_a_module_imports_only_lower_floors() -> None:
    wrong = []
    for path, tree in modules().items():
        assert room_of(path) in FLOOR_OF, f"{path} belongs to no room of docs/architecture.md"
        found = ((line, complaint(room_of(path), name)) for line, name in imported_names(ast.walk(tree)))
        wrong += [f"{path}:{line}: {said}" for line, said in found if said]
    assert not wrong, "\n".join(wrong)


def test_no_imports_go_in_a_circle() -> None:
    """Within rooms and inside functions too; a name for a type checker alone may go in a circle."""
    known = {dotted(path) for path in modules()}
    graph: dict[str, set[str]] = {}
    for path, tree in modules().items():
        names = {name for _, name in imported_names(that_run(tree))}
        graph[dotted(path)] = {n if n in known else n.rpartition(".")[0] for n in names if n.startswith(NAME)}
    found = circle(graph)
    assert not found, "a circle of imports: " + " ← ".join(found)


def test_pyopencl_and_pytorch_live_in_one_room_each_and_the_library_does_not_print() -> None:
    wrong = [
        f"{path}:{line}: {name} is another room's to import"
        for path, tree in modules().items()
        for line, name in imported_names(ast.walk(tree))
        if HOME.get(name.partition(".")[0], room_of(path)) != room_of(path)
    ]
    wrong += [
        f"{path}:{node.lineno}: the library returns or raises; the command line prints"
        for path, tree in modules().items()
        if PACKAGE in path.parents
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]
    assert not wrong, "\n".join(wrong)


def test_a_listing_says_what_is_in_a_folder() -> None:
    """Few files, and none whose name says again what its folder's name has said."""
    inside = [path for path in modules() if PACKAGE in path.parents]
    files = Counter(path.parent for path in inside if path.parent not in PER_ITEM)
    full = [(folder, count) for folder, count in files.items() if count > MOST_FILES]
    wrong = [f"{folder}: {count} files, at most {MOST_FILES}: make a folder by subject" for folder, count in full]
    for path in inside:
        folder = path.parent.name.removesuffix("s")
        if path.stem.removesuffix("s") == folder or path.stem.startswith((f"{folder}_", f"{folder}s_")):
            wrong.append(f"{path}: its name repeats its folder's")
    assert not wrong, "\n".join(wrong)


def test_the_page_is_read_as_it_is_meant_and_the_rules_see_what_they_forbid() -> None:
    assert [FLOOR_OF[room] for room in ("fields", "parallel", "cli", "__main__")] == [1, 1, 9, 10]
    assert sorted(set(FLOOR_OF.values())) == list(range(11))
    found = {room_of(path) for path in modules()}
    assert set(FLOOR_OF) <= found, f"no such room: {set(FLOOR_OF) - found}"
    assert forbidden("errors", "checks") and not forbidden("checks", "errors")
    assert [complaint("fields", name)[:7] for name in ("numpy", ".a", f"{NAME}.x.y", f"{NAME}.io")] == [
        "", "write t", "imports", "fields "
    ]  # fmt: skip
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"a"}}) and not circle({"a": {"b", "c"}, "b": {"c"}, "c": set()})
