"""Executed notebooks: each is executed once, for the tests and for the pages.

A result is kept in build/notebooks together with a key: a hash of the notebook, of every file of
vcal and of the versions of what computes. It is taken as long as the key is the same.
"""

import hashlib
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from .package import BUILD, PACKAGE, package_hash

NOTEBOOKS = Path(__file__).resolve().parents[1]
KEPT = BUILD / "notebooks"
_LONGEST_S = 900
"""For one cell, on a machine that does other things as well."""


def _key(path: Path) -> str:
    return hashlib.sha256(package_hash() + path.read_bytes()).hexdigest()


def kept(path: Path, stale: bool = False) -> nbformat.NotebookNode | None:
    """The executed notebook where there is one; with `stale` also that of an earlier vcal."""
    try:
        found = nbformat.read(KEPT / path.name, as_version=4)
    except (OSError, ValueError):
        return None
    return found if stale or found.metadata.get("vcal_key") == _key(path) else None


def executed(path: Path, environment: Mapping[str, str] | None = None) -> nbformat.NotebookNode:
    """The notebook at `path` with its outputs, executed in a temporary folder if no result is
    kept; `environment` is added to that of its kernel.

    Raises `nbclient.exceptions.CellExecutionError` for a cell that fails.
    """
    found = kept(path)
    if found is not None:
        return found
    notebook = nbformat.read(path, as_version=4)
    paths = [str(PACKAGE.parent), os.environ.get("PYTHONPATH", "")]
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    variables |= environment or {}
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook,
            timeout=_LONGEST_S,
            kernel_name="python3",
            resources={"metadata": {"path": folder}},
        )
        client.execute(env=variables)
    notebook.metadata["vcal_key"] = _key(path)
    KEPT.mkdir(parents=True, exist_ok=True)
    part = KEPT / f".{path.stem}.{os.getpid()}"
    nbformat.write(notebook, part)
    os.replace(part, KEPT / path.name)
    return notebook
