"""phyradgs-cl: OpenCL tomography for fly-scanning cone-beam CT."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("phyradgs-cl")
except PackageNotFoundError:  # run from a checkout that is not installed
    __version__ = "0+unknown"

__all__ = ["__version__"]
