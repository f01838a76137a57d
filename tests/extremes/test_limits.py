"""Small versions of benchmarks/extremes.py: where methods still work, and how they fail beyond."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.extremes import FAMILIES, METHODS, run  # noqa: E402

HELD = [
    ("tip", "generalized-α", "float64", 1e-6, 1e6),
    ("tip", "semi-implicit Euler", "float32", 1e-6, 1e3),
    ("step", "RK4", "float64", 1e-5, 0.03),
    ("step", "semi-implicit Euler, projected", "float32", 1e-5, 0.01),
    ("gains", "semi-implicit Euler", "float64", 0.01, 0.99),
    ("gains", "RK4", "float32", 0.0, 0.5),
    ("spring", "generalized-α", "float64", 0.0, 1e12),
    ("spring", "semi-implicit Euler", "float32", 0.0, 1e6),
    ("penalty", "semi-implicit Euler", "float32", 1e4, 1e12),
    ("spin", "RATTLE", "float64", 1.0, 1e3),
    ("spin", "semi-implicit Euler", "float32", 1.0, 300.0),
    ("length", "RK4, projected", "float64", 1e-6, 1e6),
    ("length", "semi-implicit Euler", "float32", 1e-6, 1e6),
    ("flat", "semi-implicit Euler, projected", "float64", 0.0, 0.1),
]


@pytest.mark.parametrize(("name", "method", "dtype", "low", "high"), HELD)
def test_a_method_holds_up_to_its_limit_and_fails_with_a_status(name, method, dtype, low, high):
    found = run(FAMILIES[name], METHODS[method], dtype)
    assert [x.value for x in found] == list(FAMILIES[name].values)
    for x in found:
        assert x.status != "NaN"
        assert np.isfinite([x.time, x.violation, x.energy]).all() or x.status != "OK"
        if low <= x.value <= high:
            assert x.held, x


def test_long_chains_of_short_links():
    """Links of a centimeter vibrate too fast for steps of a millisecond: the status says so."""
    family = replace(FAMILIES["links"], values=(2, 50, 100), steps=500)
    found = run(family, METHODS["semi-implicit Euler"], "float32")
    assert [x.held for x in found] == [True, True, False], found
    # either is possible in a blow-up: numbers overflow, or a pivot rounds to 0
    assert found[-1].status in ("NON_FINITE", "SINGULAR")


def test_worlds_do_not_notice_those_that_fail():
    """Beside failing worlds, the others give the results of single runs."""
    family, method = FAMILIES["gains"], METHODS["semi-implicit Euler"]
    among = {x.value: x for x in run(family, method, "float64")}
    values = (0.1, 0.5, 0.99)
    assert any(not x.held for x in among.values())
    for x in run(replace(family, values=values), method, "float64"):
        other = among[x.value]
        assert x.status == other.status == "OK"
        np.testing.assert_allclose(
            (x.violation, x.energy), (other.violation, other.energy), rtol=1e-6
        )
