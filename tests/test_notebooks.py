"""Every notebook runs from top to bottom and holds no outputs.

What the documentation has executed with the same vcal is not executed again.
"""

import nbformat
import pytest

from _site import executed

NOTEBOOKS = sorted(executed.NOTEBOOKS.glob("*.ipynb"))


def test_there_is_a_notebook():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_stripped(path):
    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, programs):
    notebook = executed.executed(path, programs)  # a kernel is a process of its own
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code if cell.source.strip())
    assert all(output.output_type != "error" for cell in code for output in cell.outputs)


@pytest.mark.slow
def test_a_notebook_is_executed_again_only_if_something_changed(tmp_path, monkeypatch):
    monkeypatch.setattr(executed, "KEPT", tmp_path / "kept")
    path = tmp_path / "small.ipynb"
    cell = nbformat.v4.new_code_cell("import uuid; uuid.uuid4().hex")
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), path)

    def drawn():
        return executed.executed(path).cells[0].outputs[0]["data"]["text/plain"]

    first = drawn()
    assert drawn() == first
    monkeypatch.setattr(executed, "package_hash", lambda: b"another vcal")
    assert executed.kept(path) is None and executed.kept(path, stale=True) is not None
    assert drawn() != first
