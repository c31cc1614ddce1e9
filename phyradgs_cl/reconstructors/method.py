"""What a reconstruction method says of itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from phyradgs_cl.reconstructors.result import Reconstruction


@dataclass(frozen=True)
class Method:
    """A reconstruction method: how to run it, its option presets (the first is the default), can it be resumed, can
    several ranks share its work, and whether it may end before its last iteration with some options.
    """

    run: Callable[..., Reconstruction]
    presets: Mapping[str, Any]
    is_resumable: bool = True
    is_shared: bool = False
    stops_itself: Callable[[Any], bool] = lambda options: False
