"""Compares the library with reference values from other sources, one test for each case."""

import math

import pytest

from jaxcon import verification


@pytest.mark.parametrize("name", verification.CASES)
def test_case(name):
    (checks,) = verification.run([name])
    assert checks
    assert {check.case for check in checks} == {name}
    failed = [
        f"{check.case}: {check.figure}: {check.value:.3e} exceeds {check.bound:.0e}"
        for check in checks
        if not check.passed
    ]
    assert not failed, "\n".join(failed)
    assert any(math.isfinite(check.bound) for check in checks)


def test_unknown_name_is_refused():
    with pytest.raises(ValueError, match="no case \\['pendulums'\\]"):
        next(verification.run(["pendulums"]))


def test_nan_does_not_pass():
    assert not verification.Check("case", "figure", math.nan, math.inf).passed
    assert not verification.Check("case", "figure", 2.0, 1.0).passed
    assert verification.Check("case", "figure", 1.0, 1.0).passed
