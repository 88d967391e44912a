"""What results that are kept between builds depend on: the files of vcal and what computes."""

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

import vcal

PACKAGE = Path(vcal.__file__).resolve().parent
BUILD = Path(__file__).resolve().parents[2] / "build"
"""Where results are kept, as the pages are; git ignores it."""
_COMPUTING = ("jax", "jaxlib", "numpy", "scipy", "matplotlib")


@cache
def package_hash() -> bytes:
    """Another one whenever a file of vcal or a version changes."""
    found = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            found.update(path.relative_to(PACKAGE).as_posix().encode() + path.read_bytes())
    for name in _COMPUTING:
        found.update(f"{name} {version(name)}".encode())
    return found.digest()
