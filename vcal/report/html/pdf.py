"""A page printed to PDF by a browser that is installed.

The page has a style for print, so that a PDF is what a browser prints. Chromium and its relatives
(Chrome, Edge, which every Windows has) print without a window. A library that draws pages by
itself, such as WeasyPrint, would be a second engine with gaps of its own in the style sheet, and
needs the native libraries of Pango, which a Windows computer of a workshop does not have.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ...errors import StudyError
from .folder import add_file

_NAMES = (
    "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "brave",
    "microsoft-edge", "microsoft-edge-stable", "msedge",
)  # fmt: skip
_MAC = ("Google Chrome", "Chromium", "Microsoft Edge", "Brave Browser")
_WINDOWS = (
    "Google/Chrome/Application/chrome.exe",
    "Chromium/Application/chrome.exe",
    "Microsoft/Edge/Application/msedge.exe",
)
_LONGEST_S = 180


def find_browser() -> str:
    """The program that prints: Chromium, Chrome, Edge or a relative of them.

    Raises `StudyError` where none is found.
    """
    for name in (*_NAMES, *map(str, _places())):
        if found := shutil.which(name):
            return found
    raise StudyError(
        "option --pdf: found no Chromium, Chrome or Edge, expected one of them, which prints the "
        "page; install one (on Debian or Ubuntu: apt install chromium), or leave the option out, "
        "open the page of the report in any browser and print it to a PDF there: the page has a "
        "style for print, and the result is the same"
    )


def _places() -> Iterator[Path]:
    """Where browsers are that are not on the search path."""
    if sys.platform == "darwin":
        for root in (Path("/Applications"), Path.home() / "Applications"):
            yield from (root / f"{name}.app/Contents/MacOS/{name}" for name in _MAC)
    if sys.platform == "win32":
        for variable in ("PROGRAMFILES", "PROGRAMFILES(X86)", "LOCALAPPDATA"):
            if root := os.environ.get(variable):
                yield from (Path(root) / name for name in _WINDOWS)


def print_page(page: Path, browser: str = "") -> Path:
    """Print the page of a written report; the PDF lies beside it and is a file of the report.

    Returns its path. Raises `StudyError` where no browser is found, or where it prints nothing; the
    report stays as it is then.
    """
    browser = browser or find_browser()
    printed = page.with_suffix(".pdf")
    # A profile of its own: an open window of the same browser would print nothing, and no setting
    # of the user matters.
    with tempfile.TemporaryDirectory(prefix="vcal-print-", ignore_cleanup_errors=True) as profile:
        fresh = Path(profile) / "page.pdf"
        command = [
            browser, "--headless", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer",
            f"--user-data-dir={profile}", f"--print-to-pdf={fresh}",
            *_as_root(), page.resolve().as_uri(),
        ]  # fmt: skip
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, errors="replace", timeout=_LONGEST_S
            )
            said = done.stderr.strip().splitlines()
        except (OSError, subprocess.TimeoutExpired) as error:
            said = [str(error)]
        if not fresh.is_file() or not (data := fresh.read_bytes()).startswith(b"%PDF-"):
            raise StudyError(
                f"option --pdf: {browser} printed nothing ({said[-1] if said else 'no message'}), "
                f"expected a PDF; try another Chromium or Chrome, or open {page} in any browser "
                "and print it to a PDF there: the result is the same"
            )
    add_file(page.parent, printed.name, data)
    return printed


def _as_root() -> list[str]:
    """Chromium refuses to run as root in its sandbox; the page is vcal's own, fetches nothing."""
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    return ["--no-sandbox"] if root else []
