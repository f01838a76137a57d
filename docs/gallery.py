"""Makes the pictures of the gallery from the examples, into `docs/gallery`.

    python docs/gallery.py [name …]

They are committed, so that building these pages takes no simulation but that of the notebooks.
"""

import runpy
import sys
from pathlib import Path

import jax
import matplotlib as mpl

import jaxcon as jc
from jaxcon import view

ROOT = Path(__file__).parents[1]
PLACE = ROOT / "docs" / "gallery"
PICTURES = ("bicycle", "double_pendulum", "falling_cat", "n_four_bar", "rope", "stewart_platform")
"""Examples whose own picture is shown."""
MOTIONS = {
    "four_bar": (jc.RK4(), 2e-3, 1500),
    "n_four_bar": (jc.Method().integrator, 2e-3, 1500),
}
"""Examples that are animated: an integrator, h [s], and steps."""
FRAMES = 50


def draw(name: str) -> None:
    """The picture of an example, by its own `main`."""
    runpy.run_path(str(ROOT / "examples" / f"{name}.py"))["main"](str(PLACE / f"{name}.png"))


def animate(name: str) -> None:
    """The motion of the scene that an example builds, as a GIF."""
    integrator, dt, steps = MOTIONS[name]
    system, state = runpy.run_path(str(ROOT / "examples" / f"{name}.py"))["build"]()
    method, every = jc.Method(integrator), steps // FRAMES
    run = jax.jit(lambda s: jc.rollout(system, method, s, None, dt, steps, every=every))
    final, path = run(state)
    jc.raise_for_status(final)
    motion = view.animate(system, path.q, dt * every)
    motion.save(PLACE / f"{name}.gif", writer="pillow")


def main(names: list[str]) -> None:
    """Those that are named, or all."""
    mpl.use("Agg")
    mpl.rcParams["savefig.dpi"] = 80
    PLACE.mkdir(exist_ok=True)
    for name in MOTIONS:
        if not names or f"{name}.gif" in names:
            animate(name)
    for name in PICTURES:
        if not names or f"{name}.png" in names:
            draw(name)


if __name__ == "__main__":
    main(sys.argv[1:])
