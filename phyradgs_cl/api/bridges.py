"""Operators for PyTorch."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.api.operators import LinearOperator, Operator
from phyradgs_cl.errors import InputError


def as_torch(operator: Operator) -> Callable[..., Any]:
    """The operator as a function of tensors that PyTorch can differentiate: ``f(x)``, or ``f(x, frames=[3])`` of some.

    x (domain_shape) may lie on any device and have any floating type; y (range_shape) has the same. The work is done in
    float32 on the operator's device; tensors of float32 on the host are read and made where they are, by DLPack. Linear
    operators can be differentiated any number of times, others once, and ``backward`` renders nothing again.

    Raises InputError where PyTorch is not installed, for what is no operator or tensor, and as the operator does.
    """
    torch: Any = checks.package("torch", "for as_torch", "torch")
    if not isinstance(operator, Operator):
        expected = "what ray_operator, splat_operator or voxel_operator gives"
        raise InputError("operator", type(operator).__name__, expected)

    def array(tensor: Any) -> np.ndarray:  # DLPack: torch and numpy need not know each other's versions
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
            raise InputError("x", checks.shown(x), "a tensor", "of a cloud, torch.tensor(cloud.rows())")
        of = operator if frames is None else operator.frames(frames)
        return (Linear if isinstance(of, LinearOperator) else Curved).apply(x, of)

    return function
