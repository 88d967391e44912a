"""Results as labelled tables: pandas and xarray, where they are installed; short HTML tables."""

import html
import importlib
from collections.abc import Sequence
from typing import Any


def labelling(library: str) -> Any:
    """The module `library` (pandas or xarray), which a result is converted to.

    Raises `ImportError` with the command that installs it.
    """
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise ImportError(
            f"{library} is not installed, and the result is converted to it; install it with: "
            "pip install 'vcal[data]'"
        ) from error


def html_table(caption: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table for a notebook: a caption, a header and rows of text."""

    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    body = "".join(line(row, "td") for row in rows)
    return (
        f"<table><caption>{html.escape(caption)}</caption><thead>{line(header, 'th')}</thead>"
        f"<tbody>{body}</tbody></table>"
    )
