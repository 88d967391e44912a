"""Notebooks as pages: with their outputs, executed before the pages are read if need be."""

import os
from concurrent.futures import ThreadPoolExecutor
from logging import WARNING, getLogger

import nbformat
from sphinx.application import Sphinx
from sphinx.util import logging

from .executed import KEPT, NOTEBOOKS, executed, kept


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
    getLogger("traitlets").setLevel(WARNING)  # which says that it executes, with a blank line
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
