"""Small version of the study of cost by size."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import size, structures  # noqa: E402
from jaxcon.constraints.rows import layout_of  # noqa: E402


def test_exponents_are_those_of_the_last_sizes():
    rows = [{"n": n, "step": 1e-6 * n**2.5} for n in (1, 10, 100, 1000)]
    rows[0]["step"] = 1.0  # sizes below ten are left out: overhead dominates there
    assert size.exponent(rows, "step") == pytest.approx(2.5)
    assert size.exponent(rows[:2], "step") is None
    assert size.exponent(rows, "compile") is None


def test_elimination_is_linear_where_nothing_meets_and_matrices_are_cubic():
    """Counts operations, which do not depend on the machine."""
    found = {name: list(size.series("posts", name, 0, 60.0, (10, 40))) for name in size.SOLVERS}
    powers = {name: size.exponent(rows, "operations") for name, rows in found.items()}
    for name in ("Sparse", "RankSafe", "ConjugateGradients"):
        assert powers[name] == pytest.approx(1.0, abs=0.05)
    for name in size.DENSE:
        assert 2.0 < powers[name] < 3.1
    text = size.table("posts", found | {"auto": list(size.series("posts", "auto", 0, 60.0, (10,)))})
    assert "| 10 | 10 |" in text
    assert "Sparse()" in text
    assert "exponent of operations" in text


def test_a_case_is_measured():
    found = size.case("hub", "Schur", 2, 2)
    assert (found["rows"], found["velocities"], found["failed"]) == (2, 7, 0)
    assert found["step"] > 0
    assert size.shown(found).endswith(" s)")


def test_what_is_too_large_is_not_begun_and_says_so():
    first, last = size.series("posts", "Dense", 0, 1e-9, (1, 2))
    assert first["n"] == 1
    assert last["stopped"].startswith("it would take")
    assert size.case("posts", "Dense", 1000, 10_000)["stopped"].startswith("its matrices")
    (stopped,) = size.in_process("rope", "Sparse", 1, 0.1)
    assert stopped == {"n": 1, "stopped": "over 0 s"}
    assert size.shown(stopped) == "over 0 s"


SIZES = {  # velocities and rows at size 10
    "rope": (20, 10),
    "chain": (60, 50),
    "posts": (20, 10),
    "hub": (23, 10),
    "net": (27, 15),
    "rows": (200, 10),
}


@pytest.mark.parametrize("name", structures.FAMILIES)
def test_a_family_has_as_many_as_it_says(name):
    system, state = structures.FAMILIES[name].build(10, np.float64)
    rows = layout_of(system, state.q, state.v, state.time).size
    assert (len(state.v), rows) == SIZES[name]
