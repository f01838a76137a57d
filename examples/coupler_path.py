"""A four-bar whose coupler draws a wanted path: lengths found by gradient through its closure.

    python examples/coupler_path.py

Twelve places of a point on the coupler are wanted, at twelve angles of the crank. For each angle
`jc.assemble` closes the loop, with a derivative by every length, and Gauss–Newton steps on these
make lengths and point fit. The places were drawn by a linkage that the search does not know.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import jaxcon as jc
from jaxcon import scenes

jax.config.update("jax_enable_x64", True)  # for lengths to the micrometre

ANGLES = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
TRUTH = {"lengths": jnp.array([1.1, 0.35, 0.8, 0.85]), "point": jnp.array([0.1, 0.35])}
GUESS = {"lengths": jnp.array(scenes.CRANK_ROCKER), "point": jnp.array([0.0, 0.2])}
system, state = scenes.four_bar()


def linkage(lengths: jax.Array):
    """The same linkage with other lengths of ground, crank, coupler and rocker [m]."""
    ground, crank, coupler, rocker = jnp.stack([lengths, jnp.zeros(4, lengths.dtype)], axis=1)
    return system.with_params(
        {
            "ground_crank": {"anchor_b": -crank / 2},
            "crank_coupler": {"anchor_a": crank / 2, "anchor_b": -coupler / 2},
            "coupler_rocker": {"anchor_a": coupler / 2, "anchor_b": rocker / 2},
            "rocker_ground": {"anchor_a": -rocker / 2, "anchor_b": ground},
        }
    )


@jax.jit
def turn(p: dict) -> tuple:
    """Where the point of the coupler is at each angle of the crank, (12, 2) [m], and q there."""
    own = linkage(p["lengths"])

    def place(angle: jax.Array) -> tuple:
        rough = scenes.four_bar_poses(jnp.asarray(scenes.CRANK_ROCKER), angle)
        crank = p["lengths"][1] / 2 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        q = state.q
        for name, pose in zip(("crank", "coupler", "rocker"), rough, strict=True):
            q = q.at[own.layout.q(name)].set(pose)
        q = q.at[own.layout.q("crank")[:2]].set(crank)
        closed = jc.assemble(own, q, hold="crank").state
        point = jc.position(own, closed, "coupler", p["point"])
        return jc.learning.losses.unless_failed(point, closed), closed.q

    return jax.vmap(place)(jnp.asarray(ANGLES, p["lengths"].dtype))


def draw(p: dict) -> jax.Array:
    """The places alone."""
    return turn(p)[0]


def find() -> jc.learning.Identified:
    """The lengths and the point whose path is nearest to the wanted one."""
    wanted = np.asarray(draw(TRUTH))
    return jc.identify(draw, GUESS, wanted, positive="lengths")


def main(picture: str = "coupler_path.png") -> None:
    """Finds, prints and draws."""
    found = find()
    print(found)
    start, end, wanted = (draw(p) for p in (GUESS, found.params, TRUTH))
    for label, path in (("at the start", start), ("found", end)):
        worst = float(jnp.max(jnp.linalg.norm(path - wanted, axis=1)))
        print(f"{label} the point misses its places by up to {worst:.1e} m")

    from jaxcon import view

    own = linkage(found.params["lengths"])
    axes = view.draw(own, turn(found.params)[1][1])
    axes.plot(*np.asarray(wanted).T, "ko", mfc="none", label="wanted")
    axes.plot(*np.asarray(start).T, ":", label="at the start")
    axes.plot(*np.asarray(end).T, ".-", label="found")
    axes.legend(fontsize=7)
    axes.figure.savefig(picture)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*sys.argv[1:])
