"""The runtime of an operator, and operators as functions that PyTorch can differentiate."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.operators.public import LinearOperator, Operator
from phyradgs_cl.runtime import Runtime

Device = str | Runtime | None
"""The argument ``device``: what ``--device`` takes, or a Runtime."""


def runtime_of(device: Device) -> Runtime:
    """Returns the Runtime for the argument ``device``; None is the best device."""
    if isinstance(device, Runtime):
        return device
    return _runtime_by_name(None if device is None else str(device))


@lru_cache(maxsize=4)
def _runtime_by_name(name: str | None) -> Runtime:
    """Returns the one Runtime of a device's name, so that programs are built once."""
    return Runtime(name)


def as_torch(operator: Operator) -> Callable[..., Any]:
    """Returns the operator as a function of tensors that PyTorch can differentiate: ``f(x)``, or ``f(x, frames=[3])``.

    x (domain_shape) may be on any device and of any floating type; y (range_shape) is like it. The work is done in float32
    on the operator's device; float32 tensors on the host are not copied, by DLPack. Linear operators can be differentiated
    any number of times, others once. ``backward`` does not project x again.

    Raises InputError where PyTorch is not installed, for anything but an operator or a tensor, and as the operator does."""
    torch: Any = checks.package("torch", "for as_torch", "torch")
    if not isinstance(operator, Operator):
        expected = "what ray_operator, splat_operator or voxel_operator gives"
        raise InputError("operator", type(operator).__name__, expected)

    def array(tensor: Any) -> np.ndarray:  # DLPack works with any pair of versions of torch and numpy
        return np.from_dlpack(tensor.detach().to("cpu", torch.float32).contiguous())

    def tensor(values: np.ndarray, like: Any) -> Any:
        return torch.from_dlpack(values).to(like.device, like.dtype)

    class Linear(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, x: Any, of: LinearOperator) -> Any:
            ctx.of = of
            return tensor(of(array(x)), x)

        @staticmethod
        def backward(ctx: Any, by_y: Any) -> tuple[Any, None]:
            return Linear.apply(by_y, ctx.of.T), None

    class Curved(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, x: Any, of: Operator) -> Any:
            y, ctx.back = of.vjp(array(x))
            return tensor(y, x)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, by_y: Any) -> tuple[Any, None]:
            return tensor(ctx.back(array(by_y)), by_y), None

    def function(x: Any, frames: Sequence[int] | None = None) -> Any:
        if not isinstance(x, torch.Tensor):
            raise InputError("x", checks.short_repr(x), "a tensor", "of a cloud, torch.tensor(cloud.rows())")
        of = operator if frames is None else operator.frames(frames)
        return (Linear if isinstance(of, LinearOperator) else Curved).apply(x, of)

    return function
