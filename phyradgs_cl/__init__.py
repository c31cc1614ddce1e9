"""phyradgs-cl: OpenCL tomography for fly-scanning cone-beam CT."""

__all__ = ["__version__"]


def __getattr__(name: str) -> str:
    """``__version__``, looked up when it is first asked for: the command line has to be ready for Ctrl-C by then."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        found = version("phyradgs-cl")
    except PackageNotFoundError:  # run from a checkout that is not installed
        found = "0+unknown"
    globals()[name] = found
    return found
