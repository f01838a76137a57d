"""The codemod for renamed names: small programs and texts before and after."""

import json
import sys
from pathlib import Path
from textwrap import dedent

import pytest

pytest.importorskip("libcst")
sys.path.append(str(Path(__file__).parents[1] / "tools"))
import rename  # noqa: E402

TABLE = {
    "modules": {"jaxcon.old.place": "jaxcon.new.home"},
    "names": {
        "jaxcon.Alpha": "jaxcon.greek.Alpha",
        "jaxcon.beta": "jaxcon.greek.letters.beta",
        "jaxcon.greek.gama": "jaxcon.greek.gamma",
        "jaxcon.old.place.delta": "jaxcon.new.home.epsilon",
    },
    "arguments": {"jaxcon.Alpha": {"size": "length"}},
    "calls": {"jaxcon.beta": ["x"]},
    "attributes": {"tail": "ending"},
}
"""Names that are not in the package, so that the codemod does not change this file."""


def after(source, module=None):
    return rename.renamed(dedent(source), rename.Table(**TABLE), module)


@pytest.mark.parametrize(
    ("before", "expected"),
    [
        ("import jaxcon as jc\njc.Alpha(1)\n", "import jaxcon as jc\njc.greek.Alpha(1)\n"),
        ("import jaxcon\njaxcon.Alpha.x\n", "import jaxcon\njaxcon.greek.Alpha.x\n"),
        ("import jaxcon as jc\njc.Alphabet\n", "import jaxcon as jc\njc.Alphabet\n"),
        (
            "import jaxcon as jc\njc.beta.one(2)\n",
            "import jaxcon as jc\njc.greek.letters.beta.one(2)\n",
        ),
        ("from jaxcon import Alpha\nAlpha()\n", "from jaxcon.greek import Alpha\nAlpha()\n"),
        ("from jaxcon import Alpha as A\nA()\n", "from jaxcon.greek import Alpha as A\nA()\n"),
        (
            "from jaxcon.greek import gama as g, gama\ng(gama)\n",
            "from jaxcon.greek import gamma as g, gamma\ng(gamma)\n",
        ),
        (
            "import jaxcon.old.place\njaxcon.old.place.delta()\n",
            "import jaxcon.new.home\njaxcon.new.home.epsilon()\n",
        ),
        (
            "import jaxcon.old.place as p\np.delta(p.other)\n",
            "import jaxcon.new.home as p\np.epsilon(p.other)\n",
        ),
        (
            "from jaxcon.old import place\nplace.delta(place.other)\n",
            "from jaxcon.new import home\nhome.epsilon(home.other)\n",
        ),
    ],
)
def test_names_follow_their_imports(before, expected):
    assert after(before) == expected
    assert after(expected) == expected


def test_an_import_from_two_places_becomes_two_lines():
    before = """
        x = 1

        # the reason
        from jaxcon import (Scene, Alpha, beta)  # noqa
        """
    expected = """
        x = 1

        # the reason
        from jaxcon import Scene
        from jaxcon.greek import Alpha
        from jaxcon.greek.letters import beta  # noqa
        """
    assert after(before) == dedent(expected)


def test_variables_of_the_same_name_stay():
    source = """
        import jaxcon as jc
        import other as jx

        def f(Alpha, beta=2):
            gama = Alpha + beta
            return gama + jx.Alpha

        class Local:
            Alpha = 3

        def g(jc):
            return jc.Alpha
        """
    assert after(source) == dedent(source)


def test_a_local_function_hides_an_imported_one():
    source = """
        from jaxcon.greek import gama

        def f():
            gama = 1
            return gama

        gama()
        """
    assert after(source) == dedent(
        """
        from jaxcon.greek import gamma

        def f():
            gama = 1
            return gama

        gamma()
        """
    )


def test_attributes_and_keywords_of_the_table():
    source = """
        import numpy as np
        from jaxcon import Alpha

        class Mine(Alpha):
            tail: int = 0

        x = Mine(tail=1).tail + np.tail
        tail = x
        """
    expected = source.replace("tail: int", "ending: int").replace(
        "(tail=1).tail", "(ending=1).ending"
    )
    expected = expected.replace("from jaxcon import", "from jaxcon.greek import")
    assert after(source) == dedent(expected)


def test_keywords_of_one_function():
    source = """
        import jaxcon as jc

        def other(size): return size

        x = jc.Alpha(size=1), other(size=2)
        print(x[0].size, jc.greek.Alpha(size=3))
        """
    expected = source.replace("jc.Alpha(size", "jc.greek.Alpha(length")
    doubts = []
    rename.renamed(dedent(source), rename.Table(**TABLE), None, lambda *x: doubts.append(x))
    assert after(source) == dedent(expected)
    assert doubts == [(line, "size may be length now") for line in (6, 7, 7)]


def test_definitions_in_a_module_of_the_package():
    source = "def gama():\n    return gama\n"
    assert after(source, "jaxcon.greek") == "def gamma():\n    return gamma\n"
    assert after(source, "jaxcon.latin") == source


def test_texts_in_programs():
    source = '''
        """Like `jc.Alpha`, and jaxcon.old.place.delta.

            from jaxcon import Alpha, Scene
        """
        raise ValueError(f"take jc.Alpha({1}), {2}")  # not jc.Alphabet, not abjc.Alpha
        '''
    expected = '''
        """Like `jc.greek.Alpha`, and jaxcon.new.home.epsilon.

            from jaxcon.greek import Alpha; from jaxcon import Scene
        """
        raise ValueError(f"take jc.greek.Alpha({1}), {2}")  # not jc.Alphabet, not abjc.Alpha
        '''
    assert after(source) == dedent(expected)


def test_regular_expressions_in_programs():
    source = 'match(r"^jc\\.Alpha\\(jaxcon.beta\\)")\n'
    expected = 'match(r"^jc\\.greek\\.Alpha\\(jaxcon.greek.letters.beta\\)")\n'
    assert after(source) == expected


def test_parentheses_stay():
    source = "import jaxcon as jc\nx = (\n    jc.Alpha\n)\n"
    assert after(source) == source.replace("jc.Alpha", "jc.greek.Alpha")


@pytest.fixture
def place(tmp_path):
    """A folder that contains the table; `run` rewrites its files."""
    (tmp_path / "table").mkdir()
    (tmp_path / "table" / "t.json").write_text(json.dumps(TABLE))
    return tmp_path


def run(place, *options):
    return rename.main([str(place), "--table", str(place / "table" / "t.json"), *options])


def test_markdown(place):
    path = place / "page.md"
    path.write_text(
        "Take `jc.Alpha`.\n\n```python\nfrom jaxcon.greek import gama\n"
        "x = jc.Alpha(Alpha=1)\n```\n\n"
        "```python\ny = gama(x)\n```\n\n```\njc.beta\n```\n"
    )
    assert run(place) == 0
    assert path.read_text() == (
        "Take `jc.greek.Alpha`.\n\n```python\nfrom jaxcon.greek import gamma\n"
        "x = jc.greek.Alpha(Alpha=1)\n```\n\n"
        "```python\ny = gamma(x)\n```\n\n```\njc.greek.letters.beta\n```\n"
    )


def notebook(*cells):
    kinds = [{"cell_type": kind, "source": source.splitlines(True)} for kind, source in cells]
    return json.dumps({"cells": kinds, "nbformat": 4})


def test_a_notebook(place):
    path, other = place / "book.ipynb", place / "other.ipynb"
    path.write_text(
        notebook(
            ("code", "%matplotlib inline\nfrom jaxcon import Alpha\nfrom jaxcon.greek import gama"),
            ("markdown", "Then `jc.Alpha`:"),
            ("code", "!ls\ngama(Alpha)"),
            ("code", "%%bash\necho jc.Alpha 'it"),
        )
    )
    other.write_text(untouched := notebook(("code", "x = 1")))
    assert run(place) == 0
    assert ["".join(cell["source"]) for cell in json.loads(path.read_text())["cells"]] == [
        "%matplotlib inline\nfrom jaxcon.greek import Alpha\nfrom jaxcon.greek import gamma",
        "Then `jc.greek.Alpha`:",
        "!ls\ngamma(Alpha)",
        "%%bash\necho jc.greek.Alpha 'it",
    ]
    assert other.read_text() == untouched


def test_a_page_of_sphinx(place):
    path = place / "page.rst"
    path.write_text(
        ".. currentmodule:: jaxcon\n\n.. autoclass:: Alpha\n   :members: x\n\n"
        ".. autoclass:: Scene\n\n.. currentmodule:: jaxcon.old.place\n\n"
        ".. autofunction:: delta\n\nSee :obj:`jaxcon.beta`.\n"
    )
    assert run(place) == 0
    assert path.read_text() == (
        ".. currentmodule:: jaxcon\n\n.. autoclass:: jaxcon.greek.Alpha\n   :members: x\n\n"
        ".. autoclass:: Scene\n\n.. currentmodule:: jaxcon.new.home\n\n"
        ".. autofunction:: jaxcon.new.home.epsilon\n\nSee :obj:`jaxcon.greek.letters.beta`.\n"
    )


def test_check_writes_nothing_and_says_what_would_change(place, capsys):
    path = place / "program.py"
    path.write_text(before := "import jaxcon as jc\njc.Alpha()\n")
    assert run(place, "--check") == 1
    assert path.read_text() == before
    assert capsys.readouterr().out == f"{path}\n"
    assert run(place) == 0
    assert run(place, "--check") == 0


def test_lines_that_need_a_look_are_printed(place, capsys):
    path, broken = place / "a.py", place / "b.py"
    path.write_text("import jaxcon as jc\nname = 'Alpha'\ngetattr(jc, name)\n")
    broken.write_text("x = (\n")
    moved = place / "c.py"
    moved.write_text("from jaxcon import old as o\no.place.delta()\n")
    assert run(place) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == f"{path}:3: jc is an argument of a function"
    assert said[1].startswith(f"{broken}:")
    reason = "which o does not lead to"
    assert said[2:] == [
        f"{moved}:2: jaxcon.old.place is jaxcon.new.home, {reason}",
        f"{moved}:2: jaxcon.old.place.delta is jaxcon.new.home.epsilon, {reason}",
    ]


def test_calls_with_arguments_of_before_and_imports_of_all_names_need_a_look(place, capsys):
    path, text, book = place / "a.py", place / "b.md", place / "c.ipynb"
    path.write_text("from jaxcon import *\nimport jaxcon as jc\njc.beta(1)\njc.beta(1, 2)\n")
    text.write_text("Text.\n\n```python\nx = 1\njc.beta(x, 2)\n```\n")
    book.write_text(notebook(("code", "y = 1"), ("code", "jc.beta(y, 2)")))
    hidden = place / "venv" / "lib" / "d.py"
    hidden.parent.mkdir(parents=True)
    (place / "venv" / "pyvenv.cfg").write_text("")
    hidden.write_text(before := path.read_text())
    assert run(place, "--check") == 1
    reason = "jaxcon.beta takes (x) now"
    said = [x for x in capsys.readouterr().out.splitlines() if ": " in x]
    assert said == [
        f"{path}:1: the names of jaxcon are not known here",
        f"{path}:4: {reason}",
        f"{text}:2: {reason}",
        f"{book}:1: {reason}",
    ]
    assert hidden.read_text() == before


def test_the_table_of_the_package_is_read():
    path = Path(rename.__file__).parents[1] / "jaxcon" / "renamed.json"
    table = rename.Table.read(path)
    old, new = next(iter(table.names.items()))
    assert table.in_text(old) == new
