"""Executed notebooks: each is executed once, for the tests and for the pages.

A result is kept in build/notebooks together with a key: a hash of the notebook, of every file of
vcal and of the versions of what computes. It is taken as long as the key is the same.
"""

import hashlib
import os
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib.metadata import version
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from sphinx.application import Sphinx
from sphinx.util import logging

import vcal

NOTEBOOKS = Path(__file__).resolve().parents[1]
KEPT = NOTEBOOKS.parent / "build" / "notebooks"
_PACKAGE = Path(vcal.__file__).resolve().parent
_COMPUTING = ("jax", "jaxlib", "numpy", "scipy", "matplotlib")
_LONGEST_S = 900
"""For one cell, on a machine that does other things as well."""


@cache
def _package_hash() -> bytes:
    found = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            found.update(path.relative_to(_PACKAGE).as_posix().encode() + path.read_bytes())
    for name in _COMPUTING:
        found.update(f"{name} {version(name)}".encode())
    return found.digest()


def _key(path: Path) -> str:
    return hashlib.sha256(_package_hash() + path.read_bytes()).hexdigest()


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
    paths = [str(_PACKAGE.parent), os.environ.get("PYTHONPATH", "")]
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


def _execute_all(app: Sphinx) -> None:
    """As many at a time as there are cores, each with one of them; the long ones are not known in
    advance, so that the order is that of their numbers.
    """
    if not app.config.execute_notebooks:
        return
    todo = [path for path in sorted(NOTEBOOKS.glob("*.ipynb")) if kept(path) is None]
    if not todo:
        return
    logging.getLogger(__name__).info("executing %s", ", ".join(path.stem for path in todo))
    cores = os.cpu_count() or 1
    alone = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"} if len(todo) > 1 else {}
    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(lambda path: executed(path, alone), todo))


def _put_in(app: Sphinx, name: str, source: list[str]) -> None:
    """Show the executed notebook in place of that without outputs."""
    path = NOTEBOOKS / f"{name}.ipynb"
    if not path.is_file():
        return
    found = kept(path, stale=not app.config.execute_notebooks)
    if found is not None:
        source[0] = nbformat.writes(found)
        app.env.note_dependency(KEPT / path.name)


def setup(app: Sphinx) -> dict[str, bool]:
    """Execute what is not kept, before the pages are read.

    `-D execute_notebooks=0` shows what is kept, whatever it was executed with, and the notebook
    without its outputs otherwise.
    """
    app.add_config_value("execute_notebooks", True, "env", bool)
    app.connect("builder-inited", _execute_all)
    app.connect("source-read", _put_in)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
