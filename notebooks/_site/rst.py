"""Pieces of reStructuredText that are made when the documentation is built."""

from collections.abc import Callable, Iterable, Sequence
from textwrap import indent

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from .docstrings import to_rst


def text(plain: str) -> str:
    """Plain text of vcal, with names in backticks and formulas indented."""
    return "\n".join(to_rst(plain.split("\n"))).strip()


def code(words: Iterable[str]) -> str:
    """Each word as code, with commas between them."""
    return ", ".join(f"``{word}``" for word in words)


def either(words: Iterable[str]) -> str:
    """The same with an "or" before the last."""
    return " or ".join(code(words).rsplit(", ", 1))


def heading(title: str, mark: str, label: str = "") -> str:
    """A heading underlined with `mark`, and the label under which pages refer to it."""
    before = f".. _{label}:\n\n" if label else ""
    return f"{before}{title}\n{mark * len(title)}\n\n"


def table(header: Sequence[str], rows: Iterable[Sequence[str]], style: str = "") -> str:
    """Rows of cells, each of which is reStructuredText; nothing where there are none."""
    cells = [row for row in rows]
    if not cells:
        return ""
    found = ".. list-table::\n   :widths: auto\n"
    found += f"   :class: {style}\n" if style else ""
    found += "   :header-rows: 1\n\n" if any(header) else "\n"
    for row in [header, *cells] if any(header) else cells:
        mark = "* - "
        for cell in row:
            found += f"   {mark}{indent(cell, ' ' * 7).strip()}\n"
            mark = "  - "
    return found + "\n"


def directive(make: Callable[[], str]) -> type[SphinxDirective]:
    """A directive without arguments that stands for the reStructuredText that `make` returns."""

    class Made(SphinxDirective):
        def run(self) -> list[nodes.Node]:
            return self.parse_text_to_nodes(make(), allow_section_headings=True)

    return Made
