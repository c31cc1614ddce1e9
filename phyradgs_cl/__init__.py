"""phyradgs-cl: OpenCL tomography for fly-scanning cone-beam CT."""

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

__all__ = ["__version__", "resource"]

try:
    __version__ = version("phyradgs-cl")
except PackageNotFoundError:  # the program runs from a checkout that is not installed
    __version__ = "0+unknown"


def resource(name: str) -> Path:
    """Returns the path of ``name``: ``cl``, ``data`` or ``cli.py``. A wheel has these in the package, a checkout beside it.

    Raises FileNotFoundError if ``name`` is in neither place."""
    package = Path(__file__).resolve().parent
    for folder in (package, package.parent):
        if (folder / name).exists():
            return folder / name
    raise FileNotFoundError(f"{name} is missing from the installation at {package}: install phyradgs-cl again")
