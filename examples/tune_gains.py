"""Feedback gains tuned by gradient, held against a search of the whole plane of gains.

    python examples/tune_gains.py

A four-bar runs for half a second by Heun's method at h = 5 ms. The loss is the size of its
violation; the gains α and β of the feedback are searched by their logarithms, from the default and
from a start a hundred times too small.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxcon as jc
from jaxcon import scenes

DT, STEPS, ITERATIONS = 5e-3, 100, 80
INTEGRATOR = jc.integrators.Heun()
STARTS = {"the default": 1.0, "a hundredth of it": 0.01}


def loss(gains: dict) -> jax.Array:
    """log₁₀ of the root mean square of (φ, h φ̇) over the motion [m]."""
    system, state = scenes.four_bar()
    method = jc.Method(INTEGRATOR, jc.Baumgarte(gains["alpha"], gains["beta"]), jc.solvers.Schur())
    final, off = jc.rollout(
        system, method, state, None, DT, STEPS, record=lambda s, info: info.violation
    )
    return jc.learning.losses.unless_failed(jc.learning.losses.violation(off, DT), final)


def tune(share: float) -> jc.learning.Tuned:
    """From a share of the default gains."""
    alpha, beta = INTEGRATOR.default_gains(DT)
    optimizer = optax.adam(optax.cosine_decay_schedule(0.3, ITERATIONS))
    start = {"alpha": share * alpha, "beta": share * beta}
    return jc.tune(loss, start, positive=True, steps=ITERATIONS, optimizer=optimizer)


def grid(size: int) -> tuple:
    """Gains from 1 to 100 1/s, (size,), and the loss over α and β, (size, size)."""
    gains = np.geomspace(1.0, 100.0, size)
    alpha, beta = (jnp.asarray(x.ravel()) for x in np.meshgrid(gains, gains, indexing="ij"))
    losses = jax.jit(jax.vmap(loss))({"alpha": alpha, "beta": beta})
    return gains, np.asarray(losses).reshape(size, size)


def main(picture: str = "tune_gains.png") -> None:
    """Searches the plane, tunes from both starts, and draws all of it."""
    jax.config.update("jax_enable_x64", True)  # to see violations below a micrometre
    gains, plane = grid(48)
    least = np.nanmin(plane)
    print(f"the least of a grid: a violation of {10**least:.3e} m")
    found = {name: tune(share) for name, share in STARTS.items()}
    for name, result in found.items():
        alpha, beta = (float(x) for x in result.params.values())
        more = 10 ** (result.loss - least) - 1
        print(
            f"from {name}: {10**result.loss:.3e} m ({more:+.2%}) at α = {alpha:.1f}, β = {beta:.1f}"
        )
    gain = 10 ** (found["the default"].history[0] - found["the default"].loss)
    print(f"tuned gains leave {gain:.2f} times less than the default ones")

    from jaxcon import view

    figure, (left, right) = view.pyplot().subplots(1, 2, figsize=(10, 4), layout="constrained")
    image = left.contourf(gains, gains, plane.T, levels=30)
    figure.colorbar(image, label="log₁₀ of the violation [m]")
    left.set(xscale="log", yscale="log", xlabel="α [1/s]", ylabel="β [1/s]")
    for name, result in found.items():
        left.plot(*(float(x) for x in result.params.values()), "o", mfc="none")
        right.plot(result.history, label=f"from {name}")
    right.axhline(least, color="gray", ls="--", label="the least of a grid")
    right.set(xlabel="step", ylabel="log₁₀ of the violation [m]")
    right.legend(fontsize=8)
    figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
