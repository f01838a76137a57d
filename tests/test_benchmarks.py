"""Small versions of the studies in benchmarks/."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import drift  # noqa: E402


def test_drift_grows_without_feedback_and_stays_small_with_it():
    rows = {(r[0], r[1]): r[2:] for r in drift.table(dt=2e-3, seconds=10.0)}
    perturbed, clean, exponent = rows["semi-implicit Euler", "none"]
    assert exponent > 1
    assert clean > 1e-2
    perturbed, clean, _ = rows["RK4", "none"]
    assert abs(perturbed - 1e-2) < 1e-4  # φ̇₀ t, exactly linear
    for integrator in drift.INTEGRATORS:
        perturbed, clean, _ = rows[integrator, "default"]
        assert perturbed < 1e-4
        assert clean < 1e-4
