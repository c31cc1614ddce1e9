"""The device that a call is given: a wish, or a Runtime that is already there."""

from functools import lru_cache

from phyradgs_cl.runtime import Runtime

Device = str | Runtime | None


def runtime_of(device: Device) -> Runtime:
    """The Runtime for what ``--device`` takes; None is the best device."""
    if isinstance(device, Runtime):
        return device
    return _runtime_by_name(None if device is None else str(device))


@lru_cache(maxsize=4)
def _runtime_by_name(name: str | None) -> Runtime:
    """One Runtime per device, so that programs are built once."""
    return Runtime(name)
