"""Many wrong arguments, one loop."""

from collections.abc import Callable, Mapping

import pytest

from phyradgs_cl.errors import InputError


def assert_refused(calls: Mapping[str, Callable[[], object]], error: type[Exception] = InputError) -> None:
    """Every call is refused, in words that match its key."""
    for words, call in calls.items():
        with pytest.raises(error, match=words):
            call()
            pytest.fail(f"taken, in place of {words!r}")
