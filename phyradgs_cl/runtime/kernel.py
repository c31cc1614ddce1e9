"""A kernel as an operator's constructor declares it; its program is built when it is launched the first time."""

from __future__ import annotations

from dataclasses import dataclass

from phyradgs_cl.runtime.opencl import cl


@dataclass(eq=False)
class Kernel:
    """``function_name`` of ``cl/<program>.cl``, built with ``options``; ``Runtime.launch`` takes it."""

    program: str
    function_name: str
    options: tuple[str, ...]
    built: cl.Kernel | None = None
