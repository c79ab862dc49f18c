"""HTML that cannot be broken by what is put into it: every text is escaped, only what was built here is not.

Names of scenarios, injectors and axes come from users' files and may hold anything.
"""

from collections.abc import Collection, Iterable, Sequence
from html import escape
from typing import Final, TypeAlias

_EMPTY: Final = frozenset({"meta", "br", "col"})


class Html(str):
    """A text that is HTML already."""

    __slots__ = ()


Content: TypeAlias = "str | Iterable[Content]"
"""A text, a piece of HTML, or several of them."""


def render(content: Content) -> str:
    """Content as HTML: `Html` as it is, everything else escaped."""
    if isinstance(content, Html):
        return str(content)
    if isinstance(content, str):
        return escape(content)
    return "".join(render(part) for part in content)


def tag(name: str, /, *content: Content, **attributes: str) -> Html:
    """An element. Attributes: `class_` for class, `aria_label` for aria-label; their values are escaped, too."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(value, quote=True)}"' for key, value in attributes.items()
    )
    if name in _EMPTY:
        return Html(f"<{name}{written}>")
    return Html(f"<{name}{written}>{render(content)}</{name}>")


def table(caption: str, head: Sequence[str], rows: Iterable[Sequence[Content]], texts: Collection[int] = (0,)) -> Html:
    """A table with caption and column heads, which scrolls by itself where it is wider than the screen.

    texts: the columns set to the left, all others are numbers; the first cell of a row is its head.
    """

    def cell(kind: str, column: int, content: Content, **more: str) -> Html:
        return tag(kind, content, class_="text" if column in texts else "number", **more)

    heads = tag("tr", [cell("th", k, text, scope="col") for k, text in enumerate(head)])
    body = [
        tag("tr", [cell("td", k, one) if k else cell("th", k, one, scope="row") for k, one in enumerate(row)])
        for row in rows
    ]
    whole = tag("table", tag("caption", tag("span", caption)), tag("thead", heads), tag("tbody", body))
    return tag("div", whole, class_="scroll", tabindex="0", role="region", aria_label=caption)
