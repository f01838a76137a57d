"""The saddle system that a solver sees: matrices, never joints.

[ M  −Jᵀ ] [a]   [f]
[ J   C  ] [λ] = [b]
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from jaxcon.core.numerics import finite_or_nan
from jaxcon.core.pytree import exportable, pytree, static
from jaxcon.core.status import Status
from jaxcon.core.typing import Array
from jaxcon.solvers.jacobian import Jacobian


@pytree
class Diagonal:
    """A diagonal mass matrix by its entries (n_v,)."""

    values: Array

    def solve(self, x: Array) -> Array:
        """M⁻¹ x, (n_v,); NaN where a mass is infinite."""
        return x * self._inverse()

    def solve_columns(self, x: Array) -> Array:
        """M⁻¹ X, (n_v, k); NaN where a mass is infinite."""
        return x * self._inverse()[:, None]

    def _inverse(self) -> Array:
        """1/m; not 0 of an infinite m, which would hold still what nobody fixed."""
        return 1 / finite_or_nan(self.values)

    def apply(self, x: Array) -> Array:
        """M x, (n_v,)."""
        return self.values * x

    def dense(self) -> Array:
        """M, (n_v, n_v)."""
        return jnp.diag(self.values)

    @property
    def diagonal(self) -> Array:
        """Its entries, (n_v,)."""
        return self.values

    @property
    def singular(self) -> Array:
        """Returns True where an entry is finite and not positive, ()."""
        return jnp.any(jnp.isfinite(self.values) & (self.values <= 0), axis=0)


@pytree
class Full:
    """A symmetric positive definite mass matrix (n_v, n_v)."""

    values: Array

    @property
    def factor(self) -> Array:
        """The Cholesky factor, NaN where M is not definite; constant under differentiation."""
        return jnp.linalg.cholesky(jax.lax.stop_gradient(self.values), symmetrize_input=False)

    @property
    def singular(self) -> Array:
        """Returns True where M is finite and not positive definite, ()."""
        finite = jnp.all(jnp.isfinite(self.values))
        return finite & ~jnp.all(jnp.isfinite(self.factor))

    def solve(self, x: Array) -> Array:
        """M⁻¹ x, (n_v,); NaN where M is not definite."""
        return self.solve_columns(x[:, None])[:, 0]

    def solve_columns(self, x: Array) -> Array:
        """M⁻¹ X, (n_v, k); NaN where M is not definite."""
        factor = self.factor
        return jax.lax.custom_linear_solve(
            lambda y: self.values @ y,
            x,
            lambda _, y: jax.scipy.linalg.cho_solve((factor, True), y),
            symmetric=True,
        )

    def apply(self, x: Array) -> Array:
        """M x, (n_v,)."""
        return self.values @ x

    def dense(self) -> Array:
        """M, (n_v, n_v)."""
        return self.values

    @property
    def diagonal(self) -> Array:
        """Its diagonal, (n_v,)."""
        return jnp.diagonal(self.values)


Mass = Diagonal | Full


@pytree
class Saddle:
    """M a = f + Jᵀλ, J a + C λ = b.

    Attributes:
        mass: M.
        force: f, (n_v,) [N, N m].
        jacobian: J, (n_c, n_v).
        target: b, (n_c,).
        compliance: the diagonal of C, (n_c,); None where it is zero.
        noise: what b may be off by rounding, a number or (n_c,); None where that is not known.
        loops: whether rows may depend on each other by structure, as those of closed loops do and
            those of a tree of joints do not.
        layout: which rows belong to which constraint, with `names` and `rows(name)`, for solvers
            that treat them differently; None where rows have no names.
    """

    mass: Mass
    force: Array
    jacobian: Jacobian
    target: Array
    compliance: Array | None = None
    noise: Any = None
    loops: bool = static(default=True)
    layout: Any = static(default=None)


@exportable
class Solution(NamedTuple):
    """What a solver returns; unpacks as `a, λ, status`.

    Attributes:
        acceleration: a, (n_v,).
        multipliers: λ, (n_c,).
        status: `Status` code, ().
    """

    acceleration: Array
    multipliers: Array
    status: Array


Factored = Callable[[Array, Array], Solution]
"""The solution for other f and b with the same M, J and C."""


class Solver(Protocol):
    """What every solver answers."""

    def solve(self, system: Saddle) -> Solution:
        """The acceleration and the multipliers of a saddle system."""
        ...

    def factor(self, system: Saddle) -> Factored:
        """The solution as a function of f and b; those of the system are not used."""
        ...


def free_motion(system: Saddle) -> Factored:
    """a = M⁻¹ f, where there is no constraint."""

    def solve(force: Array, target: Array) -> Solution:
        acceleration = system.mass.solve(force)
        status = judge(acceleration, system.mass.singular)
        return Solution(acceleration, jnp.zeros_like(target), status)

    return solve


def judge(x: Array, singular: Any = None) -> Array:
    """The status of a solution: SINGULAR where the solver saw it, NON_FINITE where x is."""
    finite = jnp.all(jnp.isfinite(x), axis=0)
    status = jnp.where(finite, Status.OK, Status.NON_FINITE)
    if singular is not None:
        status = jnp.where(singular, Status.SINGULAR, status)
    return status.astype(jnp.int32)
