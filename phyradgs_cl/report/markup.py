"""HTML and SVG built from elements, so that nothing from a file gets into a page unescaped."""

import html
import json

from phyradgs_cl.text import plain_text


class Markup(str):
    """Text that is HTML already; every other text is escaped where it is put into an element."""


VOID = frozenset({"br", "img", "input", "link", "meta"})


def element(name: str, /, *children: object, **attributes: object) -> Markup:
    """``<name attributes>children</name>``; what is no Markup is escaped. Attributes that are None or False are left out,
    True has no value; underscores in names become dashes, one at the end goes (``class_``)."""
    opening = f"<{name}{''.join(_attribute(key, value) for key, value in attributes.items())}>"
    return Markup(opening) if name in VOID else Markup(f"{opening}{joined(*children)}</{name}>")


def joined(*children: object) -> Markup:
    """Children one after the other, escaped where they are no Markup; None and empty ones add nothing."""
    shown = (c if isinstance(c, Markup) else html.escape(_plain(c)) for c in children if c is not None)
    return Markup("".join(shown))


def raw_text(name: str, content: str, /, **attributes: object) -> Markup:
    """A ``style`` or ``script`` element of our own text, which HTML reads without unescaping."""
    if "</" + name in content.lower():
        raise ValueError(f"{name}: the content would end its element")
    return element(name, Markup(content), **attributes)


def json_block(identifier: str, value: object) -> Markup:
    """Data for the page's script: JSON in which no element can begin or end."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    safe = text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return element("script", Markup(safe), id=identifier, type="application/json")


def _attribute(key: str, value: object) -> str:
    if value is None or value is False:
        return ""
    name = key.rstrip("_").replace("_", "-")
    return f" {name}" if value is True else f' {name}="{html.escape(_plain(value))}"'


def _plain(value: object) -> str:
    """Numbers of drawings need no more than hundredths."""
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else plain_text(str(value))
