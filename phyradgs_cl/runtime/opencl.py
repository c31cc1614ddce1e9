"""pyopencl, loaded when something of it is first used: a command that needs no device does not wait for it."""

from functools import cache
from typing import TYPE_CHECKING, Any

from phyradgs_cl.runtime import pocl

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

__all__ = ["cl"]
