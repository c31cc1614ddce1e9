"""Errors in Python's words: what the command line calls ``--time-error`` is the argument ``time_error``."""

import functools
import re
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from phyradgs_cl.errors import PhyradgsError

_ELSEWHERE = {"with": "others"}  # options whose argument has another name
_OPTION = re.compile(r"(?<!\w)'[^']*'|--set |(?<![\w-])--([a-z][a-z-]*)")  # what is quoted, a command or a value, stays
P = ParamSpec("P")
R = TypeVar("R")


def naming_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """The function, whose errors name its arguments where floors below name options of the command line."""

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except PhyradgsError as error:
            error.culprit, error.found, error.expected, error.remedy = map(
                in_python, (error.culprit, error.found, error.expected, error.remedy)
            )
            error.args = (error.culprit, error.found, error.expected, error.remedy)  # what pickling keeps
            raise

    return called


def in_python(text: str) -> str:
    """A text with the names of arguments for those of options: "leave --voxel-mm out" as "leave voxel_mm out"."""
    return _OPTION.sub(_argument, text)


def _argument(match: re.Match[str]) -> str:
    if (option := match[1]) is None:
        return "" if match[0].startswith("--") else match[0]
    return _ELSEWHERE.get(option, option.replace("-", "_"))
