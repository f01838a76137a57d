"""When a row arrives within a step, and what leads there, with the derivative of that time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxcon.core import numerics
from jaxcon.core.somewhere import somewhere
from jaxcon.core.typing import Array, PyTree
from jaxcon.core.worlds import keep, lift
from jaxcon.dynamics.parts import Outlook


class Bracket(NamedTuple):
    """What is known of an arrival, by world.

    Attributes:
        happens: whether there is one, ().
        low, high: it lies between these times, ().
        here: where it is thought to be, ().
        before, gap: the last time tried, and the least gap of an open row then, ().
        row: which one, ().
    """

    happens: Array
    low: Array
    high: Array
    here: Array
    before: Array
    gap: Array
    row: Array


@dataclass(frozen=True)
class Search:
    """For the first time at which an open row arrives.

    Attributes:
        gaps: s → φ after a part of length s, (n,).
        outlook: of the part.
        length: the longest, ().
        wanted: in which worlds it is asked for, ().
        tries: how many, after the one at the end of the part.
    """

    gaps: Callable[[Array], Array]
    outlook: Outlook
    length: Array
    wanted: Array
    tries: int

    def run(self) -> Bracket:
        """The arrival, by world; its time is the length where there is none."""
        zero, none = jnp.zeros_like(self.length), jnp.zeros(self.wanted.shape, bool)
        row = jnp.zeros(self.wanted.shape, jnp.int32)
        unknown = Bracket(none, zero, self.length, self.length, self.length, zero + jnp.inf, row)

        def once(known: Bracket, first: Array) -> tuple[Bracket, None]:
            going = self.wanted & (first | self._off(known))

            def try_() -> Bracket:
                gaps = jnp.where(self.outlook.open, self.gaps(known.here), jnp.inf)
                return keep(going, keep(first, self._begun(gaps), self._nearer(known, gaps)), known)

            return jax.lax.cond(somewhere(going), try_, lambda: known), None

        return jax.lax.scan(once, unknown, jnp.arange(self.tries + 1) == 0)[0]

    def _off(self, known: Bracket) -> Array:
        """Where a gap is left that is more than rounding."""
        return known.happens & (jnp.abs(known.gap) > self.outlook.rounding / 16)

    def _begun(self, ends: Array) -> Bracket:
        """What the gaps at the end of the part tell."""
        arriving, rounding = self.outlook.arriving, self.outlook.rounding
        at_once = jnp.any(arriving, axis=0)
        passed = jnp.any(ends < -rounding[None], axis=0)
        gaps = jnp.where(at_once[None], jnp.where(arriving, self.outlook.gap, jnp.inf), ends)
        gap, row = nearest(gaps)
        happens = at_once | passed
        guess = jnp.where(happens, self._parabola(ends), self.length)
        here = jnp.where(at_once, 0, guess)
        gap = jnp.where(at_once, 0, gap)
        return Bracket(happens, jnp.zeros_like(here), self.length, here, self.length, gap, row)

    def _parabola(self, ends: Array) -> Array:
        """Where the first of the rows that end below would arrive, were its φ a parabola in s."""
        start, rate, r = self.outlook.gap, self.outlook.rate, self.length[None]
        passed = self.outlook.open & (ends < 0)
        half = numerics.safe_divide(jnp.where(passed, ends, 0) - start - r * rate, r * r)
        root = numerics.safe_sqrt(rate * rate - 4 * half * start)
        late = numerics.safe_divide(rate + root, -2 * half)
        early = numerics.safe_divide(2 * start, root - rate)
        times = jnp.where(passed, jnp.where(rate > 0, late, early), r)
        return jnp.clip(jnp.min(times, axis=0), 0, self.length)

    def _nearer(self, known: Bracket, gaps: Array) -> Bracket:
        """Returns the bracket after one more try: a secant, or half of the interval."""
        here, (gap, row) = known.here, nearest(gaps)
        low = jnp.where(gap > 0, here, known.low)
        high = jnp.where(gap > 0, known.high, here)
        slope = numerics.safe_divide(gap - known.gap, here - known.before)
        secant = here - numerics.safe_divide(gap, slope)
        inside = (secant > low) & (secant < high)
        new = known._replace(low=low, high=high, before=here, gap=gap, row=row)
        then = jnp.where(inside, secant, (low + high) / 2)
        return new._replace(here=jnp.where(self._off(new), then, here))


def nearest(gaps: Array) -> tuple[Array, Array]:
    """The least gap and its row, by world."""
    return jnp.min(gaps, axis=0), jnp.argmin(gaps, axis=0).astype(jnp.int32)


Flow = Callable[[PyTree, Array], PyTree]


@dataclass(frozen=True)
class Arrival:
    """What a flow leads to at a time s at which a gap is closed, with the derivative of s.

    With y = F(x, s) and φ(x, y) = 0,

        ẏ = ∂F ẋ + F′ ṡ,    ṡ = −(φ along ẋ and ∂F ẋ)/(φ along F′),

    exact to every order. Where φ along F′ is no more than the least, as where a row is grazed, the
    time has no derivative, and ṡ is zero.

    Attributes:
        flow: F, (x, s) → y, by world.
        gap: φ, (x, y) → ().
    """

    flow: Flow
    gap: Callable[[PyTree, PyTree], Array]

    def __call__(self, x: PyTree, time: Array, closes: Array, least: Array) -> tuple[PyTree, Array]:
        """(y, s).

        Args:
            x: what the flow depends on.
            time: s, ().
            closes: where a gap is closed then, (); elsewhere s is what it is.
            least: of |φ̇|, ().
        """
        leaves, structure = jax.tree.flatten(x)
        arrays = [jnp.asarray(leaf) for leaf in leaves]
        inexact = [jnp.issubdtype(leaf.dtype, jnp.inexact) for leaf in arrays]
        others = [leaf for leaf, flag in zip(arrays, inexact, strict=True) if not flag]

        def whole(floats: list[Array], others: list[Array]) -> PyTree:
            iterators = {True: iter(floats), False: iter(others)}
            return jax.tree.unflatten(structure, [next(iterators[flag]) for flag in inexact])

        def derivative(primals: Any, tangents: Any) -> tuple[Any, Any]:
            floats, s, others, closes, least = primals
            moved, ṡ = tangents[:2]
            s = when(*primals)

            def flow(floats: list[Array], s: Array) -> tuple[PyTree, Array]:
                x = whole(floats, others)
                y = self.flow(x, s)
                return y, self.gap(x, y)

            (y, _), push = jax.linearize(flow, floats, s)
            ṡ = jnp.where(closes, 0, ṡ)
            ẏ, φ̇ = push(moved, ṡ)
            slope, closing = push([jnp.zeros_like(f) for f in floats], jnp.ones_like(s))
            steep = closes & (jnp.abs(closing) > least)
            late = -numerics.safe_divide(φ̇, jnp.where(steep, closing, 0))
            return (y, s), (jax.tree.map(lambda a, b: along(a, b, late), ẏ, slope), ṡ + late)

        @jax.custom_jvp
        def when(floats: Any, s: Array, *_: Any) -> Array:
            return s

        @jax.custom_jvp
        def arrive(floats: Any, s: Array, others: Any, *_: Any) -> tuple[PyTree, Array]:
            return self.flow(whole(floats, others), s), s

        @when.defjvp
        def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
            (_, s), (_, ṡ) = derivative(primals, tangents)
            return s, ṡ

        arrive.defjvp(derivative)
        floats = [leaf for leaf, flag in zip(arrays, inexact, strict=True) if flag]
        return arrive(floats, time, others, closes, least)


def along(ẏ: Any, slope: Any, time: Array) -> Any:
    """ẏ + F′ ṡ of one result; what is no number has none."""
    if ẏ.dtype == jax.dtypes.float0:
        return ẏ
    return ẏ + slope * lift(time, slope)
