"""The docstring of every name of the API states its parameters, shapes, units and errors."""

import inspect
import re
from collections.abc import Iterator
from typing import Any

import pytest

from phyradgs_cl import api

SHAPE = re.compile(r"\((?:[A-Z]\w*|\.\.\.|n?[zvyxu]|n|rows|lines|\d+)(?:,|\))")
UNIT = re.compile(r"(?<!')\b(mm|s|rad(ians)?|deg(rees)?|dB|dimensionless|line integrals?|counts)\b|_(mm|s|rad|deg)\b")
ERROR = re.compile(r"\b[A-Z]\w*Error\b|\bKeyboardInterrupt\b")
ARRAYS = ("ndarray", "NDArray", "ArrayLike", "Gaussians", "Scan")


def said(name: str) -> str:
    """The docstring of a name; empty where a dataclass generated it."""
    doc = inspect.getdoc(getattr(api, name)) or ""
    return "" if doc.startswith(f"{name}(") else doc


def parameters(thing: Any) -> list[inspect.Parameter]:
    """The parameters of a function or a constructor that users give."""
    if inspect.isclass(thing) and (issubclass(thing, BaseException) or getattr(thing, "_is_protocol", False)):
        return []
    found = inspect.signature(thing).parameters.values()
    return [p for p in found if p.name not in ("self", "subject") and not p.name.startswith("_")]


def members(name: str) -> Iterator[tuple[str, Any]]:
    """The public methods and properties that a class of ours defines itself."""
    thing = getattr(api, name)
    if inspect.isclass(thing) and thing.__module__.startswith("phyradgs_cl"):
        for member, value in vars(thing).items():
            if not member.startswith("_") and (inspect.isroutine(value) or isinstance(value, property | classmethod)):
                yield member, value.__func__ if isinstance(value, classmethod | staticmethod) else value


def missing(name: str) -> list[str]:
    """The parts that the docstring of a name lacks."""
    thing, doc = getattr(api, name), said(name)
    if not doc:
        return ["a docstring"]
    taken = parameters(thing)
    lacks = [f"its parameter {p.name}" for p in taken if not re.search(rf"\b{p.name}\b", doc)]
    annotations = " ".join([str(p.annotation) for p in taken] + [str(getattr(thing, "__annotations__", {}).get("return"))])
    if any(word in annotations for word in ARRAYS) and not SHAPE.search(doc):
        lacks.append("the shape of its arrays")
    if any(word in annotations for word in ("float", *ARRAYS)) and not UNIT.search(doc):
        lacks.append("its units")
    if taken and not ERROR.search(doc):
        lacks.append("the error that it raises")
    lacks += [f"a docstring of {member}" for member, value in members(name) if not inspect.getdoc(value)]
    return lacks


@pytest.mark.parametrize("name", api.__all__)
def test_a_name_says_what_it_takes_and_gives(name) -> None:
    assert not missing(name), f"{name} does not say {', '.join(missing(name))}"
