"""Where the files beside the package are: inside it in a wheel, beside it in a checkout."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def resource(name: str) -> Path:
    """The path of ``cl``, ``data`` or ``cli.py``: the copy inside the package if there is one, else the one beside it;
    FileNotFoundError for neither."""
    for folder in (_PACKAGE, _PACKAGE.parent):
        if (folder / name).exists():
            return folder / name
    raise FileNotFoundError(
        f"{name} is missing from the installation at {_PACKAGE}: install phyradgs-cl again"
    )
