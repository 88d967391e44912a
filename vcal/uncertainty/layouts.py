"""A table with text below it, as plain text, Markdown, LaTeX or HTML."""

import html
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

Layout = Literal["markdown", "plain", "latex", "html"]

_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "ν_eff": r"$\nu_\mathrm{eff}$",
    "∞": r"$\infty$",
    "−": "$-$",
    "–": "--",
    "δ": r"$\delta$",
    "±": r"$\pm$",
    "µ": r"$\mu$",
    "°": r"$^\circ$",
}
"""What LaTeX needs in place of a character, or of a symbol of these tables."""


def laid_out(
    heads: Sequence[str],
    align: str,
    lines: Sequence[Sequence[str]],
    below: str = "",
    notes: Sequence[str] = (),
    layout: Layout = "markdown",
) -> str:
    """A table with one line of text and remarks below.

    `align` has an ``l`` or ``r`` per column. Raises `ValueError` for an unknown layout.
    """
    if layout not in _LAYOUTS:
        known = ", ".join(repr(name) for name in _LAYOUTS)
        raise ValueError(f"layout: found {layout!r}, expected one of {known}")
    return _LAYOUTS[layout](_Table(heads, align, lines, below, notes))


class _Table(NamedTuple):
    """The arguments of `laid_out`."""

    heads: Sequence[str]
    align: str
    lines: Sequence[Sequence[str]]
    below: str
    notes: Sequence[str]


def _markdown(table: _Table) -> str:
    heads, align, lines, below, notes = table
    rule = ["---:" if side == "r" else "---" for side in align]
    rows = [heads, rule, *lines]
    written = "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows
    )
    listed = "\n".join(f"- {note}" for note in notes)
    return "\n\n".join(part for part in (written, below, listed) if part)


def _plain(table: _Table) -> str:
    heads, align, lines, below, notes = table
    widths = [max(len(row[i]) for row in (heads, *lines)) for i in range(len(heads))]

    def row(cells: Sequence[str]) -> str:
        padded = (
            cell.rjust(width) if side == "r" else cell.ljust(width)
            for cell, width, side in zip(cells, widths, align, strict=True)
        )
        return "  ".join(padded).rstrip()

    written = "\n".join([row(heads), "  ".join("-" * width for width in widths), *map(row, lines)])
    return "\n\n".join(part for part in (written, below, "\n".join(notes)) if part)


def _latex(table: _Table) -> str:
    heads, align, lines, below, notes = table

    def row(cells: Sequence[str]) -> str:
        return " & ".join(map(_escaped, cells)) + r" \\"

    written = "\n".join(
        [
            rf"\begin{{tabular}}{{{align}}}",
            r"\hline",
            row(heads),
            r"\hline",
            *map(row, lines),
            r"\hline",
            r"\end{tabular}",
        ]
    )
    return "\n\n".join(part for part in (written, _escaped(below), *map(_escaped, notes)) if part)


def _html(table: _Table) -> str:
    heads, align, lines, below, notes = table

    def row(cells: Sequence[str], tag: str) -> str:
        style = {"l": "", "r": ' style="text-align:right"'}
        written = "".join(
            f"<{tag}{style[side]}>{html.escape(cell)}</{tag}>"
            for cell, side in zip(cells, align, strict=True)
        )
        return f"<tr>{written}</tr>"

    parts = ["<table>", f"<thead>{row(heads, 'th')}</thead>", "<tbody>"]
    parts += [*(row(cells, "td") for cells in lines), "</tbody>", "</table>"]
    if below:
        parts.append(f"<p>{html.escape(below)}</p>")
    if notes:
        listed = "".join(f"<li>{html.escape(note)}</li>" for note in notes)
        parts.append(f"<ul>{listed}</ul>")
    return "\n".join(parts)


def _escaped(text: str) -> str:
    found, at = [], 0
    while at < len(text):
        symbol = "ν_eff" if text.startswith("ν_eff", at) else text[at]
        found.append(_LATEX.get(symbol, symbol))
        at += len(symbol)
    return "".join(found)


_LAYOUTS: dict[str, Callable[[_Table], str]] = {
    "markdown": _markdown,
    "plain": _plain,
    "latex": _latex,
    "html": _html,
}
