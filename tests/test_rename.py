"""The codemod for renamed names: small programs and texts before and after."""

import importlib
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
PATH = Path(rename.__file__).parents[1] / "jaxcon" / "renamed.json"


def after(source, module=None):
    return rename.renamed(dedent(source), rename.Table(**TABLE), module)


def doubts(source, table=None):
    """Returns (line, reason) of the lines that need a look."""
    said = []
    table = rename.Table(**TABLE) if table is None else table
    rename.renamed(dedent(source), table, None, lambda *doubt: said.append(doubt))
    return said


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
        from jaxcon import Scene  # noqa
        from jaxcon.greek import Alpha  # noqa
        from jaxcon.greek.letters import beta  # noqa
        """
    assert after(before) == dedent(expected)


def test_comments_inside_an_import_stay():
    before = """
        from jaxcon import (  # noqa: F401
            # all of it
            Scene,
            Alpha,  # the reason
            # for jc.beta
            beta,
        )  # the end
        from jaxcon.greek import (
            gama,  # another reason
            omega,
        )
        """
    expected = """
        # all of it
        from jaxcon import Scene  # noqa: F401
        from jaxcon.greek import Alpha  # the reason  # noqa: F401
        # for jc.greek.letters.beta
        from jaxcon.greek.letters import beta  # noqa: F401  # the end
        from jaxcon.greek import (
            gamma,  # another reason
            omega,
        )
        """
    assert after(before) == dedent(expected)
    assert doubts(before) == []


def test_a_comment_that_has_no_place_is_printed():
    before = "if True: from jaxcon import (Alpha,  # the reason\n    Scene)\n"
    expected = "if True: from jaxcon.greek import Alpha; from jaxcon import Scene\n"
    assert after(before) == expected
    assert doubts(before) == [(1, "the comment # the reason is left out")]


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
    assert after(source) == dedent(expected)
    assert doubts(source) == [(line, "size may be length now") for line in (6, 7, 7)]


def test_definitions_in_a_module_of_the_package():
    source = "def gama():\n    return gama\n"
    assert after(source, "jaxcon.greek") == "def gamma():\n    return gamma\n"
    assert after(source, "jaxcon.latin") == source


def test_texts_in_programs():
    source = '''
        """Like `jc.Alpha`, and jaxcon.old.place.delta.

            from jaxcon import Alpha, Scene
        """
        size: "jc.Alpha | None" = None  # not jc.Alphabet, not abjc.Alpha

        def f(x: "list[jc.beta]") -> Callable[["jc.beta"], None]: ...
        '''
    expected = '''
        """Like `jc.greek.Alpha`, and jaxcon.new.home.epsilon.

            from jaxcon.greek import Alpha; from jaxcon import Scene
        """
        size: "jc.greek.Alpha | None" = None  # not jc.Alphabet, not abjc.Alpha

        def f(x: "list[jc.greek.letters.beta]") -> Callable[["jc.greek.letters.beta"], None]: ...
        '''
    assert after(source) == dedent(expected)
    assert doubts(source) == []


def test_strings_that_are_no_texts_stay_and_are_printed():
    source = r'''
        open("out/jaxcon.beta.json")
        getLogger("jaxcon.old.place.file")
        match(r"^jc\.Alpha")
        raise ValueError(f"take jc.Alpha({1}), {2}", "not jc.Alphabet")
        run(""""
            from jaxcon import Alpha""")
        x: Literal["jc.Alpha"]
        '''
    assert after(source) == dedent(source)
    alpha = "a string contains jc.Alpha; it is jc.greek.Alpha now"
    assert doubts(source) == [
        (2, "a string contains jaxcon.beta; it is jaxcon.greek.letters.beta now"),
        (3, "a string contains jaxcon.old.place; it is jaxcon.new.home now"),
        (4, r"a string contains jc\.Alpha; it is jc\.greek\.Alpha now"),
        (5, alpha),
        (
            7,
            "a string contains from jaxcon import Alpha; it is from jaxcon.greek import Alpha now",
        ),
        (8, alpha),
    ]


def test_keys_that_are_called_like_an_argument_are_printed():
    source = """
        import jaxcon as jc
        system.with_params({"rub": {"size": 2.0}})
        system.params["rub"]["size"]
        jc.Alpha(**{"size": 1})
        params.get("size", "size" in params)
        tune(loss, params, positive=["*/size"])
        title = "size"
        """
    assert after(source) == dedent(source).replace("jc.Alpha", "jc.greek.Alpha")
    assert doubts(source) == [(n, "size may be length now") for n in (3, 4, 5, 6, 6, 7)]
    assert doubts(source.replace("import jaxcon as jc", "")) == []


def test_functions_with_other_arguments_that_are_passed_on_are_printed():
    source = """
        import jaxcon as jc
        from jaxcon import beta
        jax.vmap(jc.beta, in_axes=(None, 0))
        partial(jc.beta, system)
        jc.beta(*given)
        beta(**given)
        read = beta
        jc.beta(1)
        jc.beta.__doc__
        """
    passed, called = "jaxcon.beta is passed on; it takes (x) now", "jaxcon.beta takes (x) now"
    reasons = [passed, passed, called, called, passed]
    assert doubts(source) == [(n, reason) for n, reason in enumerate(reasons, start=4)]


def test_classes_that_define_members_of_before_are_printed():
    source = """
        import jaxcon as jc
        from jaxcon.stabilization.baumgarte import Unstabilized

        class First(jc.Baumgarte):
            def target(self, rows, memory, dt): ...

            def bounded(self, stable_rate): ...

        class Second(Unstabilized):
            def impose(self, rows, memory, dt): ...

        class Third(Second):
            def target(self, rows, memory, dt): ...

        class New(jc.stabilizers.Unstabilized):
            def constraint_equations(self, rows, memory, dt): ...

            def target(self, rows): ...

        class Step(jc.integrators.Explicit):
            bounded = False

        class Other:
            def target(self): ...
        """
    said = [x for x in doubts(source, rename.Table.read(PATH)) if "defines" in x[1]]
    new = "which is constraint_equations now"
    assert said == [
        (6, f"First defines target, {new}"),
        (8, "First defines bounded, which is cap_gains now"),
        (11, f"Second defines impose, {new}"),
        (14, f"Third defines target, {new}"),
        (22, "Step defines bounded, which is supports_inequalities now"),
    ]


def test_calls_of_renamed_methods_are_printed():
    source = "import jaxcon\nmethod.feedback(dt)\nfeedback(dt)\nx.feedback = 1\n"
    reason = "feedback may be stabilizer_for now"
    assert doubts(source, rename.Table.read(PATH)) == [(2, reason)]


def test_imports_that_fail_are_printed():
    source = """
        import jaxcon as jc
        import jaxcon.simulation.events
        from jaxcon.dynamics.scene import Scene, Other
        from jaxcon.simulation.integrators import Advanced, Explicit
        from jaxcon import Dense, environments, scenes, __version__
        jc.dynamics, jc.Dense, jc.environments, jc.__doc__
        """
    assert doubts(source, rename.Table.read(PATH)) == [
        (3, "there is no module jaxcon.simulation.events now"),
        (4, "there is no module jaxcon.dynamics.scene now"),
        (5, "jaxcon.methods.integrators has no Explicit now"),
        (7, "jaxcon has no dynamics now"),
    ]


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


@pytest.mark.parametrize(
    ("name", "head", "encoding"),
    [
        ("a.py", "", "utf-8"),
        ("a.py", "", "utf-8-sig"),
        ("a.py", "# -*- coding: latin-1 -*-\n", "latin-1"),
        ("a.md", "```python\n", "utf-8-sig"),
        ("a.rst", "", "utf-8"),
    ],
)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_line_endings_and_encodings_stay(place, name, head, encoding, newline):
    end = "x = jc.Alpha()\n```\n" if name == "a.md" else "# `jc.Alpha`\n"
    before = f"{head}# ä\nfrom jaxcon import Scene, Alpha\n{end}"
    after = before.replace("jc.", "jc.greek.").replace(
        "Scene, Alpha\n", "Scene\nfrom jaxcon.greek import Alpha\n"
    )
    if name == "a.rst":
        after = after.replace("Scene\nfrom", "Scene; from")
    path = place / name
    path.write_bytes(before.replace("\n", newline).encode(encoding))
    assert run(place) == 0
    assert path.read_bytes() == after.replace("\n", newline).encode(encoding)


def test_mixed_line_endings_stay(place):
    program, text = place / "a.py", place / "b.md"
    program.write_bytes(b"import jaxcon as jc\r\njc.Alpha()\nx = 1\r\n")
    text.write_bytes(b"Text\n```python\r\njc.Alpha(Alpha=1)\r\n```\r\n")
    assert run(place) == 0
    assert program.read_bytes() == b"import jaxcon as jc\r\njc.greek.Alpha()\nx = 1\r\n"
    assert text.read_bytes() == b"Text\n```python\r\njc.greek.Alpha(Alpha=1)\r\n```\r\n"


def test_a_file_that_cannot_be_decoded_is_printed(place, capsys):
    path, other = place / "a.md", place / "b.md"
    path.write_bytes("ä jc.Alpha".encode("latin-1"))
    other.write_text("jc.Alpha")
    assert run(place) == 0
    assert capsys.readouterr().out.startswith(f"{path}:1: the file cannot be decoded: ")
    assert other.read_text() == "jc.greek.Alpha"


@pytest.mark.parametrize("old", rename.Table.read(PATH).modules)
def test_a_module_has_moved_to_where_it_can_be_imported(old):
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module(old)
    importlib.import_module(rename.Table.read(PATH).modules[old])


@pytest.mark.parametrize(
    ("module", "names"),
    [
        ("jaxcon.stabilization.baumgarte", ["Unstabilized", "Baumgarte"]),
        ("jaxcon.stabilization.gains", ["by_row"]),
        ("jaxcon.simulation.integrators", ["Advanced"]),
        ("jaxcon.core.worlds", ["per_world"]),
        ("jaxcon.solvers.saddle", ["Solution", "free_motion", "judge"]),
        ("jaxcon.solvers.schur", ["delassus"]),
        ("jaxcon.model.system", ["BodySystem"]),
        ("jaxcon.model.layout", ["Layout"]),
    ],
)
def test_names_of_moved_modules_can_be_imported(module, names):
    for home, name in rename.Table.read(PATH).homes(module, names):
        assert hasattr(importlib.import_module(home), name)


def test_the_table_of_the_package_is_read():
    table = rename.Table.read(PATH)
    old, new = next(iter(table.names.items()))
    assert table.in_text(old) == new
