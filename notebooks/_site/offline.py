"""Pages that are whole: nothing that a reader's browser would have to fetch from elsewhere."""

import re
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

_FETCHED = re.compile(
    r"<(?:script|img|iframe|source|link(?=[^>]*\brel=\"(?:stylesheet|preload|icon)\"))"
    r"[^>]*?\b(?:src|href)=\"(?P<address>(?:https?:)?//[^\"]+)\"",
    re.IGNORECASE,
)


def fetched(page: str) -> list[str]:
    """The addresses that a browser would fetch to show a page."""
    return [found["address"] for found in _FETCHED.finditer(page)]


def _check(app: Sphinx, exception: Exception | None) -> None:
    if exception is not None or app.builder.format != "html":
        return
    for path in sorted(Path(app.outdir).rglob("*.html")):
        addresses = fetched(path.read_text(encoding="utf-8"))
        if addresses:
            name = path.relative_to(app.outdir)
            raise ExtensionError(f"{name} would fetch {', '.join(sorted(set(addresses)))}")


def setup(app: Sphinx) -> dict[str, bool]:
    """Look at every page that was built; one that would fetch something fails the build."""
    app.connect("build-finished", _check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
