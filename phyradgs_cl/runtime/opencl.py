"""Loads pyopencl at its first use, and reads the sources of kernels from ``cl/``.

Headers are pasted into the sources, because OpenCL's include path fails on a folder with a space in its name. ``#line``
directives keep file and line right in the compiler's messages."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from phyradgs_cl import resource
from phyradgs_cl.runtime import pocl

__all__ = ["Kernel", "cl", "kernel_source", "naming_failures", "placed_errors"]

if TYPE_CHECKING:
    import pyopencl as cl
else:

    _prepare_once = cache(pocl.prepare_environment)

    class _WhenUsed:
        def __getattr__(self, name: str) -> Any:
            _prepare_once()  # PoCL reads its cache folder from the environment when it loads
            import pyopencl

            return getattr(pyopencl, name)

    cl = _WhenUsed()

P = ParamSpec("P")
R = TypeVar("R")
_LINE, _UNNAMED = re.compile(r'#line (\d+) "(.*)"$'), re.compile(r"^<kernel>:(\d+)")
_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')


@dataclass(eq=False)
class Kernel:
    """The kernel ``function_name`` of ``cl/<program>.cl``, built with ``options`` at its first launch.

    ``most_items``: the largest work-group that the driver allows, in work-items; None until it has been asked."""

    program: str
    function_name: str
    options: tuple[str, ...]
    built: "cl.Kernel | None" = None
    most_items: int | None = None


@cache
def kernel_source(name: str) -> str:
    """Returns the text of ``cl/<name>.cl`` with its headers pasted in, each once."""
    pasted: set[str] = set()
    return "\n".join(_expand(f"{name}.cl", pasted))


def _expand(relative: str, pasted: set[str]) -> list[str]:
    lines = [f'#line 1 "{relative}"']
    text = (resource("cl") / relative).read_text()
    for number, line in enumerate(text.splitlines(), start=1):
        match = _INCLUDE.match(line)
        if match is None:
            lines.append(line)
        elif match.group(1) not in pasted:
            pasted.add(match.group(1))
            lines += _expand(match.group(1), pasted)
            lines.append(f'#line {number + 1} "{relative}"')
        else:
            lines.append("")  # an empty line keeps the line numbers
    return lines


def placed_errors(log: str, source: str) -> list[str]:
    """Returns the lines of a compiler's log that tell errors, with file and line as in ``source``'s ``#line`` directives.
    NVIDIA's compiler ignores the directives and counts from the source's first line, so its line numbers are translated."""
    files, place = [""], ("", 0)
    for line in source.splitlines():
        named = _LINE.match(line)
        place = (named.group(2), int(named.group(1)) - 1) if named else (place[0], place[1] + 1)
        files.append(f"{place[0]}:{place[1]}")
    errors = [line.strip() for line in log.splitlines() if "error:" in line]
    return [_UNNAMED.sub(lambda at: files[min(int(at.group(1)), len(files) - 1)], line) for line in errors]


def naming_failures(work: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorates a method of ``Runtime``: an OpenCL error becomes a DeviceError or MemoryShortage that names ``work``, such
    as "a copy". Drivers only queue a launch, so its failure may show in a later call, which waits for it."""

    def decorate(method: Callable[P, R]) -> Callable[P, R]:
        @wraps(method)
        def named(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return method(*args, **kwargs)
            except cl.Error as error:
                raise args[0].ledger.error(work, error, args[0].queue) from error  # type: ignore[attr-defined]

        return named

    return decorate
