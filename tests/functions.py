"""Functions of arrays (4, n), as users write them in forces and constraints, to test compilation.

Each function tests one error that a fused kernel could make: an argument left unread, an operation
that must not be in a kernel, or a value lost or confused with another.
"""

import jax
import jax.numpy as jnp
import numpy as np

NEAR = (np.asarray(0.123456789), np.asarray(0.1234567891))


def chain_of_shared_values(x, y):
    """Each value is used twice by the next: without sharing, that makes 2⁴⁰ operations."""
    a, b = x, y
    for _ in range(40):
        a, b = 0.5 * (a * b + a), 0.5 * (a * b - b)
    return [a, b]


def rows_and_loops(x, y):
    def body(carry, row):
        turned = jnp.sin(carry) * row + jnp.cos(carry)
        return turned * turned - 0.1 * turned, turned + row

    last, rows = jax.lax.scan(body, x[0], jnp.concatenate([x, y * 2.0]))
    return [last, rows[::-1], jnp.stack([last, x[1]])]


def rows_changed_in_place(x, y):
    def body(i, rows):
        row = jnp.sin(rows[i]) * x[i] + rows[0]
        return rows.at[i].set(row + rows[i] * row)

    return [jax.lax.fori_loop(0, 4, body, y), jax.lax.fori_loop(0, 0, body, y)]


def loops_with_unused_parts(x, y):
    def body(carry, row):
        a, b = carry
        return (a * row[1] + jnp.sin(a), b * y[0] + jnp.cos(b)), (a * row[0], b)

    (a, _), (rows, _) = jax.lax.scan(body, (x[0], y[2]), jnp.stack([x, y], 1))
    return [a + 1.0, rows[:2]]


def loops_of_what_no_kernel_holds(x, y):
    matrix = jnp.eye(4, dtype=x.dtype) * 2 + 0.1

    def body(_, a):
        solved = jnp.linalg.solve(matrix, matrix @ jnp.sort(a, axis=0) + y)
        return solved + jnp.sum(a) / a.size + jnp.cumsum(x, axis=0)

    return [jax.lax.fori_loop(0, 3, body, x)]


def loops_with_branches(x, y):
    def body(i, a):
        return jax.lax.cond(i % 2 == 0, lambda a: a + jnp.cos(a) * y, lambda a: a - x, a)

    start = jax.lax.while_loop(lambda a: jnp.sum(a[0]) < 0, lambda a: a + 1.0, y)
    return [jax.lax.fori_loop(0, 3, body, start)]


def loops_in_branches(x, y):
    """The inputs x and y of the tests take the first branch, and −x takes the second."""

    def turned(z):
        return jax.lax.fori_loop(0, 5, lambda i, a: jnp.sin(a) * 1.1 - jnp.cos(a * 0.3), z)

    z = jnp.exp(-x * x) + y
    a, b = jax.lax.cond(
        jnp.sum(x) > 0,
        lambda a, b: (turned(a) + b, a * b),
        lambda a, b: (a - b, turned(b * 2.0)),
        z,
        jnp.sin(y) * z,
    )
    return [a * z, b + x]


def loops_of_one_round(x, y):
    def body(carry, row):
        a, b = carry
        return (b, jnp.sin(b) * y[0] + row), a

    return [jax.lax.scan(body, (x[0], x[1]), y[:1])[1] + 1.0]


def equal_loops(x, y):
    u, v = (jax.lax.fori_loop(0, 3, lambda i, a: jnp.sin(a) * y + x, x) for _ in range(2))
    return [u + v[::-1], u + jnp.sum(v, axis=0)[None]]


def random_keys(x, y):
    def body(i, carry):
        key, a = carry
        key = jax.random.fold_in(key, i)
        return key, a + jax.random.uniform(key, a.shape, a.dtype) * y

    return [jax.lax.fori_loop(0, 3, body, (jax.random.key(7), x))[1]]


def reductions(x, y):
    return [
        jnp.sum(x * y, axis=0),
        jnp.sum(jnp.concatenate([x, y[:1]]), axis=0),
        jnp.max(x[:3] + y[:3], axis=0),
        jnp.min(x.reshape(2, 2, -1), axis=(0, 1)),
        jnp.all(x > y, axis=0),
        jnp.any(x[:3] > y[:3], axis=0),
        jnp.sum(x, axis=1),
    ]


def arguments_that_do_not_matter(x, y):
    same = jnp.where(y > 0, x, x)
    one = jax.lax.pow(y, jnp.zeros_like(y))
    return [same * 2.0, x**0 + 0.0 * x, jnp.where(True, x, y), x * one - 0.0, jnp.clip(y, 1, 1)]


def joined_and_cut_again(x, y):
    joined = jnp.concatenate([x, y])
    twice = jnp.concatenate([joined[:4], joined[:4]])
    shifted = jnp.concatenate([joined[1:4], joined[:1]])
    return [-jnp.sin(twice[2:6]), shifted * 2.0, jax.lax.dynamic_slice_in_dim(joined, 0, 4) + 1.0]


def padded_and_cropped(x, y):
    moved = jax.lax.pad(y, jnp.ones((), y.dtype), [(-4, 4, 0), (0, 0, 0)])
    full = jax.lax.pad(x, y[0, 0], [(0, 0, 0), (0, 0, 0)])
    return [moved * 2.0, full + 1.0, jnp.pad(y, ((4, 0), (0, 0)))[:4] + x]


def rows_out_of_bounds(x, y):
    return [y.at[np.array([7, 8])].get(mode="fill", fill_value=0.5) + x[:2], x[np.array([3, 0, 0])]]


def constants_that_are_nearly_equal(x, y):
    a, b = (jnp.asarray(value, x.dtype) for value in NEAR)
    return [x * a, x * b]


def matrices(x, y):
    a = x @ x.T + 4 * jnp.eye(4, dtype=x.dtype)
    factor = jnp.linalg.cholesky(a)
    return [factor * 2.0 + jnp.sin(a), jnp.linalg.solve(a, y * x)]


def results_as_they_come(x, y):
    return [x, jnp.zeros((2, 3)), x, x + y, jnp.zeros((0, 3))]


FUNCTIONS = [
    chain_of_shared_values,
    rows_and_loops,
    rows_changed_in_place,
    loops_with_unused_parts,
    loops_of_what_no_kernel_holds,
    loops_with_branches,
    loops_in_branches,
    loops_of_one_round,
    equal_loops,
    random_keys,
    reductions,
    arguments_that_do_not_matter,
    joined_and_cut_again,
    padded_and_cropped,
    rows_out_of_bounds,
    constants_that_are_nearly_equal,
    matrices,
    results_as_they_come,
]
WIDE = [
    rows_and_loops,
    rows_changed_in_place,
    loops_with_unused_parts,
    joined_and_cut_again,
    padded_and_cropped,
]
"""Functions tested on arrays so large that XLA splits them among threads."""
