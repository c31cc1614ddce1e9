"""Writes the pages in docs/reference from the code and examples/: python docs/make_reference.py

tests/test_docs.py fails where the committed pages lack a command, an option or a name of the API.
"""

import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import click
import typer

from phyradgs_cl import api
from phyradgs_cl.__main__ import load_cli

FOLDER = Path(__file__).resolve().parent / "reference"
NOTE = "<!-- made from the code by docs/make_reference.py; do not edit -->\n"


def cli_page() -> str:
    """Returns every command's help, as the terminal shows it at 100 columns."""
    group = typer.main.get_command(load_cli().app)
    text = [
        NOTE,
        "# Command line reference\n",
        "What `--help` says. With explanations: [command line](../cli.md).\n",
    ]
    whole = _context(group, "phyradgs")
    text += [f"```text\n{_help(whole)}```\n"]
    for name, command in group.commands.items():  # type: ignore[attr-defined]
        text += [f"## phyradgs {name}\n", f"```text\n{_help(_context(command, name, whole))}```\n"]
    return "\n".join(text)


def _context(command: click.Command, name: str, parent: click.Context | None = None) -> click.Context:
    settings = {**command.context_settings, "terminal_width": 100, "max_content_width": 100}
    return click.Context(command, parent=parent, info_name=name, **settings)


def _help(context: click.Context) -> str:
    return "\n".join(line.rstrip() for line in context.get_help().splitlines()) + "\n"


def api_page() -> str:
    """Returns every public name with its signature and docstring."""
    text = [
        NOTE,
        "# Python reference\n",
        "`from phyradgs_cl.api import ...`; examples: [Python](../api.md).\n",
    ]
    for name in sorted(api.__all__, key=str.casefold):
        text += _entry(name, getattr(api, name), "## ")
    return "\n".join(text)


def examples_page() -> str:
    """Returns the scripts in examples/ as they are."""
    text = [
        NOTE,
        "# Examples\n",
        "Scripts that run as they stand (`python examples/NAME.py`), each in less than a minute on two cores; "
        "`watch_folder.py` takes two folders and goes on.\n",
    ]
    for path in sorted((FOLDER.parent.parent / "examples").glob("*.py")):
        script = path.read_text(encoding="utf-8")
        text += [f"## {path.stem}\n", f"```python\n{script}```\n"]
    return "\n".join(text)


def _entry(name: str, thing: object, heading: str) -> Iterator[str]:
    yield f"{heading}{name}\n"
    signature = str(inspect.signature(thing)).replace("'", "")  # type: ignore[arg-type]
    signature = re.sub(r"\b(phyradgs_cl|collections|pathlib|typing)\.[a-z_.]*", "", signature)  # short names, as in the code
    signature = signature.replace("numpy.", "np.")
    signature = re.sub(r"<function (\w+) at 0x\w+>", r"\1", signature)  # the address changes from run to run
    yield f"```python\n{name}{signature}\n```\n"
    yield f"```text\n{inspect.getdoc(thing) or ''}\n```\n"
    if inspect.isclass(thing):
        bases = [base for base in thing.__mro__ if base is thing or base.__name__.startswith("_")]
        for member, value in (item for base in bases for item in vars(base).items()):
            function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
            if not member.startswith("_") and inspect.isfunction(function):
                yield from _entry(f"{name}.{member}", function, "### ")


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, page in (("cli.md", cli_page()), ("api.md", api_page()), ("examples.md", examples_page())):
        (FOLDER / name).write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
