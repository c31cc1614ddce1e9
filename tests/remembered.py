"""Twins that are asked once: what they give does not depend on how a kernel was built, of which there are four ways."""

import hashlib
import pickle
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec

import numpy as np

Asked = ParamSpec("Asked")


def remembered(function: Callable[Asked, np.ndarray]) -> Callable[Asked, np.ndarray]:
    """The function, whose result for the same arguments (by their content) is kept, and not to be written to."""
    made: dict[bytes, np.ndarray] = {}

    @wraps(function)
    def ask(*arguments: Asked.args, **options: Asked.kwargs) -> np.ndarray:
        key = hashlib.sha256(pickle.dumps((arguments, options))).digest()
        if key not in made:
            made[key] = function(*arguments, **options)
            made[key].flags.writeable = False
        return made[key]

    return ask
