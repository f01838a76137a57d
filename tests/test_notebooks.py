"""The notebooks run from top to bottom without warnings, each in its own kernel."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_there_are_five_and_they_are_committed_without_results():
    assert [path.stem[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05"]
    for path in NOTEBOOKS:
        notebook = read(path)
        nbformat.validate(notebook)
        assert all(not c.outputs and c.execution_count is None for c in code_cells(notebook)), path


def test_each_begins_with_its_number_and_teaches_by_an_equation():
    for number, path in enumerate(NOTEBOOKS, 1):
        texts = [c.source for c in read(path).cells if c.cell_type == "markdown"]
        assert texts[0].startswith(f"# {number}. ")
        assert any("$$" in text for text in texts), path
        assert texts[-1].startswith("**Try.**"), path


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path, tmp_path):
    notebook = read(path)
    place = {"metadata": {"path": str(tmp_path)}}
    client = NotebookClient(notebook, timeout=None, kernel_name="python3", resources=place)
    client.execute()
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    results = [result for cell in cells for result in cell.outputs]
    assert [r.text for r in results if r.get("name") == "stderr"] == []
    shown = [kind for r in results for kind in r.get("data", {})]
    assert shown.count("image/png") >= 1
    animated = any("view.animate" in cell.source for cell in cells)
    assert ("text/html" in shown) == animated
