"""The time at which a gap closes within a step, the state at that time, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxcon.contact.parts import ContactForecast
from jaxcon.core import numerics
from jaxcon.core.pytree import LeafPartition
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array, PyTree
from jaxcon.staging.worlds import expand_like, where_tree

Start = TypeVar("Start", bound=PyTree)
End = TypeVar("End")


class Bracket(NamedTuple):
    """A time interval in which a gap closes, for each world.

    Times are counted from the start of the part of the step.

    Attributes:
        happens: True where a gap closes within the part of the step, ().
        low, high: times before and after the closing, ().
        here: estimate of the closing time, ().
        before, gap: the time at which gaps were last evaluated, and the smallest gap of an open row
            at that time, ().
        row: the index of the row with this smallest gap, ().
    """

    happens: Array
    low: Array
    high: Array
    here: Array
    before: Array
    gap: Array
    row: Array


@dataclass(frozen=True)
class ArrivalSearch:
    """Finds the first time in a part of a step at which the gap of an open row closes.

    A row is open if it does not rest in contact at the start of the part.

    Attributes:
        gaps: function s → the gaps φ, (n,), at the time s after the start of the part.
        forecast: gaps and rates of the rows at the start of the part.
        length: the length of the part, the largest s, ().
        wanted: mask of the worlds to search, ().
        tries: the largest number of evaluations of `gaps` after the first one, which is at the end
            of the part.
    """

    gaps: Callable[[Array], Array]
    forecast: ContactForecast
    length: Array
    wanted: Array
    tries: int

    def run(self) -> Bracket:
        """Returns the final bracket of each world, with the estimate of the closing time.

        In worlds in which no gap closes, the estimate is the end of the part.
        """
        zero, none = jnp.zeros_like(self.length), jnp.zeros(self.wanted.shape, bool)
        row = jnp.zeros(self.wanted.shape, jnp.int32)
        unknown = Bracket(none, zero, self.length, self.length, self.length, zero + jnp.inf, row)

        def once(bracket: Bracket, first: Array) -> tuple[Bracket, None]:
            going = self.wanted & (first | self._off(bracket))

            def narrowed() -> Bracket:
                gaps = jnp.where(self.forecast.open, self.gaps(bracket.here), jnp.inf)
                new = where_tree(first, self._at_end(gaps), self._nearer(bracket, gaps))
                return where_tree(going, new, bracket)

            return jax.lax.cond(somewhere(going), narrowed, lambda: bracket), None

        return jax.lax.scan(once, unknown, jnp.arange(self.tries + 1) == 0)[0]

    def _off(self, bracket: Bracket) -> Array:
        """Returns True for each world whose search must go on, ().

        In such a world a gap closes, but the smallest gap at the last evaluation is not zero to
        rounding.
        """
        return bracket.happens & (jnp.abs(bracket.gap) > self.forecast.rounding / 16)

    def _at_end(self, ends: Array) -> Bracket:
        """Returns the first bracket, from the gaps at the end of the part.

        A parabola φ(s) is fitted to each row whose gap is negative at the end. It has the gap and
        rate of the row at the start, and the gap at the end. The estimate of the closing time is
        the earliest zero of these parabolas. It is 0 if a gap is zero and closing at the start.

        Args:
            ends: the gaps at the end of the part, (n,); infinite for rows that are not open.
        """
        arriving, start, rate = self.forecast.arriving, self.forecast.gap, self.forecast.rate
        at_once = jnp.any(arriving, axis=0)
        happens = at_once | jnp.any(ends < -self.forecast.rounding[None], axis=0)
        gap, row = nearest(jnp.where(at_once[None], jnp.where(arriving, start, jnp.inf), ends))
        r, below = self.length[None], self.forecast.open & (ends < 0)
        half = numerics.safe_divide(jnp.where(below, ends, 0) - start - r * rate, r * r)
        root = numerics.safe_sqrt(rate * rate - 4 * half * start)
        late = numerics.safe_divide(rate + root, -2 * half)
        early = numerics.safe_divide(2 * start, root - rate)
        times = jnp.where(below, jnp.where(rate > 0, late, early), r)
        guess = jnp.clip(jnp.min(times, axis=0), 0, self.length)
        here = jnp.where(at_once, 0, jnp.where(happens, guess, self.length))
        gap = jnp.where(at_once, 0, gap)
        return Bracket(happens, jnp.zeros_like(here), self.length, here, self.length, gap, row)

    def _nearer(self, bracket: Bracket, gaps: Array) -> Bracket:
        """Returns the bracket narrowed by the gaps at its estimate, with a new estimate.

        The new estimate is the zero of the secant through the last two gaps. If this zero lies
        outside of the bracket, the new estimate is the middle of the bracket.

        Args:
            bracket: the bracket so far.
            gaps: the gaps at the time `bracket.here`, (n,); infinite for rows that are not open.
        """
        here, (gap, row) = bracket.here, nearest(gaps)
        low = jnp.where(gap > 0, here, bracket.low)
        high = jnp.where(gap > 0, bracket.high, here)
        slope = numerics.safe_divide(gap - bracket.gap, here - bracket.before)
        secant = here - numerics.safe_divide(gap, slope)
        new = bracket._replace(low=low, high=high, before=here, gap=gap, row=row)
        then = jnp.where((secant > low) & (secant < high), secant, (low + high) / 2)
        return new._replace(here=jnp.where(self._off(new), then, here))


def nearest(gaps: Array) -> tuple[Array, Array]:
    """Returns the smallest of the gaps (n,) and the index of its row, for each world."""
    return jnp.min(gaps, axis=0), jnp.argmin(gaps, axis=0).astype(jnp.int32)


@dataclass(frozen=True)
class Arrival(Generic[Start, End]):
    """Evaluates y = F(x, s) at the time s at which a gap φ closes, with the derivative of s.

    The derivatives follow from y = F(x, s) and φ(x, y) = 0:

        ẏ = ∂F ẋ + F′ ṡ,    ṡ = −Dφ(ẋ, ∂F ẋ)/Dφ(0, F′),    ∂F = ∂F/∂x,  F′ = ∂F/∂s,

    where Dφ(ẋ, ẏ) is the directional derivative of φ. This is exact to every order. If |Dφ(0, F′)|
    is at most `least`, as at a grazing contact, s has no derivative, and ṡ is set to zero.

    Attributes:
        flow: function (x, s) → y = F(x, s), for each world.
        gap: function (x, y) → the gap φ, ().
    """

    flow: Callable[[Start, Array], End]
    gap: Callable[[Start, End], Array]

    def __call__(self, x: Start, time: Array, closes: Array, least: Array) -> tuple[End, Array]:
        """Returns y = F(x, s) and s, both with derivatives.

        Args:
            x: argument x of the flow.
            time: closing time s, ().
            closes: mask of the worlds in which a gap closes at s, (). In other worlds s keeps its
                own derivative.
            least: threshold on |Dφ(0, F′)|, (): at or below it, s gets no derivative.
        """
        parts = LeafPartition.of(x)

        def derivative(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
            floats, s, others, closes, least = primals
            moved, ṡ = tangents[:2]
            s = when(*primals)

            def flow(floats: list[Array], s: Array) -> tuple[End, Array]:
                x = parts.merge(floats, others)
                y = self.flow(x, s)
                return y, self.gap(x, y)

            (y, _), push = jax.linearize(flow, floats, s)
            ṡ = jnp.where(closes, 0, ṡ)
            ẏ, φ̇ = push(moved, ṡ)
            slope, closing = push([jnp.zeros_like(f) for f in floats], jnp.ones_like(s))
            steep = closes & (jnp.abs(closing) > least)
            late = -numerics.safe_divide(φ̇, jnp.where(steep, closing, 0))

            def along(ẏ: Array, slope: Array) -> Array:
                """Returns the tangent of one leaf of y: `ẏ` plus `slope` times the change of s.

                Integer leaves have tangents of dtype float0, which stay as they are.
                """
                return ẏ if ẏ.dtype == jax.dtypes.float0 else ẏ + slope * expand_like(late, slope)

            return (y, s), (jax.tree.map(along, ẏ, slope), ṡ + late)

        @jax.custom_jvp
        def when(floats: list[Array], s: Array, *_: PyTree) -> Array:
            return s

        @jax.custom_jvp
        def arrive(floats: list[Array], s: Array, others: list[Array], *_: PyTree) -> Any:
            return self.flow(parts.merge(floats, others), s), s

        @when.defjvp
        def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
            (_, s), (_, ṡ) = derivative(primals, tangents)
            return s, ṡ

        arrive.defjvp(derivative)
        floats, others = parts.split(x)
        return arrive(floats, time, others, closes, least)
