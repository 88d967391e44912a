"""Docstrings of vcal as reStructuredText.

They are plain text: paragraphs, lists with dashes, formulas in ASCII that are indented, and names
in backticks. Characters that mean something to reStructuredText mean themselves in them.
"""

import re
from collections.abc import Iterable, Iterator

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

_SPAN = re.compile(
    r"``(?P<literal>.+?)``|`(?P<name>[^`]+)`|(?P<strong>(?<!\S)\*\w[^*\n]*\w\*(?!\w))"
)
_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")
_ITEM = re.compile(r"(- |\d+\. )")


def to_rst(text: Iterable[str]) -> list[str]:
    """The lines of a docstring, common indentation removed, as lines of reStructuredText."""
    found: list[str] = []
    inside = 0  # indentation of the text of a list item
    for block in _blocks(text):
        depth = len(block[0]) - len(block[0].lstrip())
        item = _ITEM.match(block[0])
        if item:
            for each in _items(block):
                found += [*_marked(each), ""]
            inside = len(item.group())
        elif depth == 0:
            found += [*_marked(block), ""]
            inside = 0
        elif depth == inside:
            found += [*_marked(block), ""]
        else:
            margin = " " * inside
            least = min(len(line) - len(line.lstrip()) for line in block)
            found += [f"{margin}.. code-block:: text", ""]
            found += [f"{margin}   {line[least:]}" for line in block]
            found += [""]
    return found


def _blocks(text: Iterable[str]) -> Iterator[list[str]]:
    """Runs of lines without a blank one, split where a list begins or text is indented anew."""
    block: list[str] = []
    for line in text:
        line = line.rstrip()
        begins = bool(_ITEM.match(line)) and bool(block) and not _ITEM.match(block[0])
        if block and (not line or (begins and block[-1].endswith(":"))):
            yield block
            block = []
        if line:
            block.append(line)
    if block:
        yield block


def _items(block: list[str]) -> Iterator[list[str]]:
    item: list[str] = []
    for line in block:
        if _ITEM.match(line) and item:
            yield item
            item = []
        item.append(line)
    yield item


def _marked(block: list[str]) -> list[str]:
    """A paragraph or a list item with its names marked and everything else escaped.

    A formula below ``::`` is a code block of its own, so that one colon is left.
    """
    text = re.sub(r"::\Z", ":", "\n".join(block))
    parts, at = [], 0
    for span in _SPAN.finditer(text):
        parts.append(_escaped(text[at : span.start()]))
        if span["strong"]:
            parts.append(span.group())
        else:
            before, after = text[: span.start()][-1:], text[span.end() :][:1]
            glued = "\\ " if before.isalnum() else ""
            content = " ".join((span["literal"] or span["name"]).split("\n"))
            content = re.sub(" +", " ", content)
            name = span["name"] and _NAME.fullmatch(content)
            parts.append(f"{glued}:py:obj:`{content}`" if name else f"{glued}``{content}``")
            parts.append("\\ " if after.isalnum() else "")
        at = span.end()
    parts.append(_escaped(text[at:]))
    first = "".join(parts)
    if not _ITEM.match(first):
        # "F. van den Bergh" begins no list, ":" no field.
        first = re.sub(r"^(\w+|#)([.)])(?=\s|$)", r"\1\\\2", first)
        first = re.sub(r"^([:+\-–—•]|\.\. |>>> )", r"\\\1", first)
    return first.split("\n")


def _escaped(text: str) -> str:
    text = re.sub(r"([\\*|`])", r"\\\1", text)
    return re.sub(r"(?<=[\w\]])_(?!\w)", r"\\_", text)


class Plain(SphinxDirective):
    """``.. plain:: TEXT``: a text of vcal on a page of reStructuredText."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        return self.parse_text_to_nodes("\n".join(to_rst(self.arguments[0].split("\n"))))


def _converted(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]):
    lines[:] = to_rst(lines)


def setup(app: Sphinx) -> dict[str, bool]:
    """Have autodoc read the docstrings of vcal this way."""
    app.add_directive("plain", Plain)
    app.connect("autodoc-process-docstring", _converted)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
