"""The option ``--pdf`` of commands that write a page."""

from pathlib import Path

from .session import say


def require_page(pdf: bool, out: Path | None) -> None:
    """Refuse ``--pdf`` of a command that writes a page only with ``--out``, where that is missing.

    Raises `StudyError`.
    """
    if pdf and out is None:
        from ..errors import StudyError

        raise StudyError(
            "--pdf: found no --out, expected a folder for the page that is printed; give one"
        )


def browser_for(pdf: bool) -> str:
    """The browser that will print, found before the work; empty where nothing is to be printed.

    Raises `StudyError` where there is none.
    """
    if not pdf:
        return ""
    from ..report.html.pdf import find_browser

    return find_browser()


def print_with(browser: str, page: Path) -> None:
    """Print the page to a PDF beside it, where there is a browser to do it."""
    if browser:
        from ..report.html.pdf import print_page

        say(f"PDF: {print_page(page, browser)}")
