"""phyradgs-cl: OpenCL tomography for fly-scanning cone-beam CT."""

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

__all__ = ["__version__", "resource"]

try:
    __version__ = version("phyradgs-cl")
except PackageNotFoundError:  # run from a checkout that is not installed
    __version__ = "0+unknown"


def resource(name: str) -> Path:
    """Returns the path of ``cl``, ``data`` or ``cli.py``. A wheel has them inside the package, a checkout next to it.

    Raises FileNotFoundError where both are missing."""
    package = Path(__file__).resolve().parent
    for folder in (package, package.parent):
        if (folder / name).exists():
            return folder / name
    raise FileNotFoundError(f"{name} is missing from the installation at {package}: install phyradgs-cl again")
