"""Verification against published reference values: benchmarks, papers and closed-form solutions.

Each case builds a scene through the public interface, simulates it in float64 and compares it with
values from `data/`. Each file there names its source. `CASES` lists all cases and `run` runs them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import jax

import jaxcon as jc
from jaxcon.verification import (
    andrews,
    bicycle,
    closed_forms,
    convergence,
    departures,
    fekete,
    four_bar,
    gradients,
    mechanisms,
    nonholonomic,
    pendulums,
    reorientation,
    rheonomic,
    rolling,
    rotations,
    single_joints,
    singular,
    stabilisation,
    statics,
    suspended,
)
from jaxcon.verification.case import Check

CASES: dict[str, Callable[[], list[Check]]] = {
    case.__name__: case
    for case in (
        pendulums.simple_pendulum,
        pendulums.double_pendulum,
        pendulums.chain_pendulum,
        pendulums.spherical_pendulum,
        rotations.tumbling_body,
        rotations.symmetric_body,
        rotations.steady_top,
        rotations.heavy_top,
        rheonomic.bead_on_hoop,
        reorientation.zero_momentum_reorientation,
        nonholonomic.chaplygin_sleigh,
        nonholonomic.ball_on_turntable,
        nonholonomic.nonholonomic_particle,
        rolling.rolling_disc,
        rolling.rolling_coin,
        rolling.knife_edge_incline,
        rolling.vakonomic_knife_edge,
        bicycle.bicycle_linear,
        closed_forms.atwood,
        closed_forms.incline,
        closed_forms.conical_pendulum,
        closed_forms.physical_pendulum,
        departures.ladder,
        departures.sphere_departure,
        andrews.andrews_squeezer,
        fekete.fekete,
        four_bar.four_bar,
        four_bar.trapezoid,
        single_joints.single_joints,
        singular.n_four_bar_2,
        mechanisms.hooke_joint,
        mechanisms.slider_crank,
        statics.static_reactions,
        statics.tension,
        statics.power,
        statics.balance,
        suspended.hanging_chain,
        stabilisation.feedback_in_time,
        stabilisation.feedback_in_steps,
        stabilisation.feedback_limits,
        convergence.order_in_plane,
        convergence.order_in_space,
        gradients.pendulum_gradients,
    )
}
"""All cases by name; each returns its checks."""


def run(names: Iterable[str] | None = None) -> Iterator[list[Check]]:
    """Runs cases one after the other.

    Args:
        names: the names of the cases to run; None runs all cases.

    Yields:
        The checks of each case. A case whose simulation fails has one check, with value NaN.

    Raises:
        ValueError: a name is unknown, or JAX does not use float64.
    """
    chosen = list(CASES if names is None else names)
    unknown = sorted(set(chosen) - set(CASES))
    if unknown:
        raise ValueError(f"verification: there is no case {unknown}; there are {list(CASES)}.")
    if not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "verification: the references hold to ten digits and more, so float64 is needed:"
            " jax.config.update('jax_enable_x64', True) at the start."
        )
    for name in chosen:
        try:
            yield CASES[name]()
        except jc.SimulationError as error:
            yield [Check(name, f"the simulation: {error}", float("nan"), 0.0)]


__all__ = ["CASES", "Check", "run"]
