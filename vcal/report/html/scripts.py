"""The scripts of a page, which it holds as they are.

A page has those that its content needs. Its security policy names them by their hash and lets no
other one run.
"""

import base64
import functools
import hashlib
from pathlib import Path

from markupsafe import Markup

SCENE, SORT = "scene.js", "sort.js"


@functools.cache
def script(name: str) -> Markup:
    """The text of a script."""
    return Markup(Path(__file__).with_name(name).read_text(encoding="utf-8"))


@functools.cache
def script_hash(name: str) -> str:
    """Its hash, as a content security policy names it."""
    digest = hashlib.sha256(script(name).encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode()}"
