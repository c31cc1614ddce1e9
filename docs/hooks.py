"""Hooks of mkdocs: formulas become MathML, which browsers draw without scripts or network."""

import re
from typing import Any
from xml.etree.ElementTree import Element

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor
from markdown.preprocessors import Preprocessor

_BLOCK = re.compile(r"\$\$(.+?)\$\$", re.DOTALL)
_INLINE = r"(?<![\\$])\$(?!\$)([^$\n]+(?:\n[^$\n]+)?)\$(?!\$)"


def on_config(config: Any) -> Any:
    """Adds the extension to those of mkdocs.yml."""
    config.markdown_extensions.append(Formulas())
    return config


def on_page_content(html: str, **_: Any) -> str:
    """Replaces \\| in the code of a table's cell. GitHub reads it as |; this Markdown keeps the backslash."""
    return html.replace(r"\|", "|")


class Formulas(Extension):
    """$inline$ and $$block$$ formulas."""

    def extendMarkdown(self, md: Markdown) -> None:
        md.preprocessors.register(_Blocks(md), "formula-blocks", 27)  # after fenced code has been put aside
        md.inlinePatterns.register(_Inline(_INLINE, md), "formula", 189)  # before emphasis, after code spans


class _Blocks(Preprocessor):
    def run(self, lines: list[str]) -> list[str]:
        def stash(match: re.Match[str]) -> str:
            drawn = f'<div class="formula">{convert(_plain(match[1]), display="block")}</div>'
            return f"\n\n{self.md.htmlStash.store(drawn)}\n\n"

        return _BLOCK.sub(stash, "\n".join(lines)).split("\n")


class _Inline(InlineProcessor):
    def handleMatch(self, m: re.Match[str], data: str) -> tuple[Element | str, int, int]:  # type: ignore[override]
        return self.md.htmlStash.store(convert(_plain(m[1]))), m.start(0), m.end(0)


def _plain(formula: str) -> str:
    """Returns a formula in one line, rewritten where latex2mathml draws it wrongly."""
    return " ".join(formula.split()).replace(r"\big", "").replace(r"\Big", "")
