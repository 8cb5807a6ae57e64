"""Small pieces of HTML."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape

Cell = str | tuple[str, str]
"""Of a table: text, or (HTML, class)."""

_KINDS = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg"}


def uri(content: bytes, kind: str = "") -> str:
    """Content as an address. kind: its media type; empty: that of a PNG or JPEG image."""
    media = kind or next(name for start, name in _KINDS.items() if content.startswith(start))
    return f"data:{media};base64,{base64.b64encode(content).decode()}"


def figure(content: bytes, alt: str, caption: str = "", size: tuple[int, int] | None = None) -> str:
    """An image with a caption. size: width, height in pixels, so that the page does not jump while it loads."""
    box = "" if size is None else f' width="{size[0]}" height="{size[1]}"'
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img src="{uri(content)}" alt="{escape(alt)}"{box}>{below}</figure>'


def section(name: str, title: str, *content: str) -> str:
    """A chapter."""
    body = "\n".join(part for part in content if part)
    return f'<section id="{name}">\n<h2>{escape(title)}</h2>\n{body}\n</section>'


def paragraph(words: str, kind: str = "") -> str:
    """Plain text."""
    return f"<p{_class(kind)}>{escape(words)}</p>"


def notes(items: Iterable[str]) -> str:
    """A list of remarks; nothing for none."""
    rows = "".join(f"<li>{escape(item)}</li>" for item in items)
    return f'<ul class="notes">{rows}</ul>' if rows else ""


def table(heads: Sequence[Cell], rows: Iterable[Sequence[Cell]]) -> str:
    """A table that scrolls in itself where it is wider than the page."""
    head = "".join(_cell(h, "th") for h in heads)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>\n" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table></div>'


def tiles(pairs: Iterable[tuple[str, str]]) -> str:
    """Numbers (large) and what they are (small)."""
    items = "".join(f"<li><b>{escape(number)}</b><span>{escape(words)}</span></li>" for number, words in pairs)
    return f'<ul class="tiles">{items}</ul>'


def bar(percent: float) -> str:
    """A bar as wide as this share of its place."""
    return f'<span class="bar" style="width:{percent:.1f}%"></span>'


def _cell(cell: Cell, tag: str = "td") -> str:
    content, kind = (escape(cell), "") if isinstance(cell, str) else cell
    return f"<{tag}{_class(kind)}>{content}</{tag}>"


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""
