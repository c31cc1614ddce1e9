"""Kernels as they are declared, and their sources: files of ``cl/`` with their headers pasted in.

An include path would fail on a folder whose name has a space, so headers are pasted with ``#line``
marks, and the compiler's messages keep naming file and line.
"""

import re
from dataclasses import dataclass
from functools import cache

from phyradgs_cl.resources import resource
from phyradgs_cl.runtime.opencl import cl

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')


@dataclass(eq=False)
class Kernel:
    """``function_name`` of ``cl/<program>.cl``, built with ``options`` at its first launch; ``Runtime.launch`` takes it."""

    program: str
    function_name: str
    options: tuple[str, ...]
    built: "cl.Kernel | None" = None


@cache
def kernel_source(name: str) -> str:
    """The text of ``cl/<name>.cl`` with every header pasted once."""
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
            lines.append("")  # keeps the count of lines
    return lines
