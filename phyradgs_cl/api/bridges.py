"""Operators for scipy and PyTorch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from typing import Protocol as Interface

import numpy as np
from scipy.sparse.linalg import LinearOperator

from phyradgs_cl.api.projectors import Projector
from phyradgs_cl.errors import InputError


class Linear(Interface):
    """What can be handed to scipy or torch: A and Aᵀ between arrays of two shapes."""

    frames_shape: tuple[int, ...]

    def forward(self, volume: np.ndarray) -> np.ndarray: ...

    def adjoint(self, frames: np.ndarray) -> np.ndarray: ...


def as_linear_operator(operator: Linear) -> LinearOperator:
    """A ``RayOperator`` (or ``Projector.of_densities``) for scipy: flat float32 vectors, matvec and rmatvec.

    operator: anything linear with forward and adjoint. Raises InputError for what is not.
    """
    domain, frames = _shapes(operator)

    def matvec(x: np.ndarray) -> np.ndarray:
        return operator.forward(np.asarray(x, np.float32).reshape(domain)).ravel()

    def rmatvec(y: np.ndarray) -> np.ndarray:
        return operator.adjoint(np.asarray(y, np.float32).reshape(frames)).ravel()

    shape = (int(np.prod(frames)), int(np.prod(domain)))
    return LinearOperator(shape, matvec=matvec, rmatvec=rmatvec, dtype=np.float32)


def as_torch(operator: Linear | Projector) -> Callable[[Any], Any]:
    """The operator as a function of tensors that PyTorch can differentiate, computed in float32.

    Of a linear operator: volumes to frames, differentiable any number of times. Of a ``Projector``: parameter rows (11, G)
    to frames, differentiable once. Tensors may lie on any device; the work is done on ours.

    Raises InputError where PyTorch is not installed, or the operator has no transpose.
    """
    try:
        import torch
    except ImportError as error:
        raise InputError("as_torch", "no PyTorch", "the package torch", "pip install torch") from error

    def array(
        tensor: Any,
    ) -> np.ndarray:  # DLpack, because torch and numpy need not know each other's versions
        return np.from_dlpack(tensor.detach().to("cpu", torch.float32).contiguous())

    def tensor(values: np.ndarray, like: Any) -> Any:
        return torch.from_dlpack(np.array(values, np.float32)).to(like.device, like.dtype)

    if isinstance(operator, Projector):
        return _splat_function(torch, operator, array, tensor)
    _shapes(operator)
    return _linear_function(torch, operator, array, tensor)


def _linear_function(torch: Any, operator: Linear, array: Any, tensor: Any) -> Callable[[Any], Any]:
    class Forward(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, volume: Any) -> Any:
            return tensor(operator.forward(array(volume)), volume)

        @staticmethod
        def backward(ctx: Any, by_frames: Any) -> Any:
            return Adjoint.apply(by_frames)

    class Adjoint(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, frames: Any) -> Any:
            return tensor(operator.adjoint(array(frames)), frames)

        @staticmethod
        def backward(ctx: Any, by_volume: Any) -> Any:
            return Forward.apply(by_volume)

    return Forward.apply


def _splat_function(torch: Any, projector: Projector, array: Any, tensor: Any) -> Callable[[Any], Any]:
    class Splat(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, rows: Any) -> Any:
            ctx.save_for_backward(rows)
            return tensor(projector.project_rows(array(rows)), rows)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, by_frames: Any) -> Any:
            (rows,) = ctx.saved_tensors
            return tensor(projector.rows_gradient(array(rows), array(by_frames)), rows)

    return Splat.apply


def _shapes(operator: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """What a linear operator takes and gives."""
    if not all(hasattr(operator, name) for name in ("volume_shape", "frames_shape", "forward", "adjoint")):
        expected = "a RayOperator, or what Projector.of_densities gives"
        raise InputError("operator", type(operator).__name__, expected)
    return tuple(operator.volume_shape), tuple(operator.frames_shape)
