import numpy as np

import jaxcon as jc
from jaxcon import scenes, view


def test_links_end_at_the_hinges():
    system, state = scenes.four_bar()
    links = view.links(system, state.q)
    assert set(links) == {"crank", "coupler", "rocker"}
    np.testing.assert_allclose(links["crank"][0], (0.0, 0.0), atol=1e-12)
    tip = links["crank"][1]
    assert min(np.linalg.norm(tip - point) for point in links["coupler"]) < 1e-12
    np.testing.assert_allclose(np.max(links["rocker"][:, 0]), 1.0, atol=1e-12)


def test_draw_draws_each_body_in_space_too():
    import matplotlib as mpl

    mpl.use("Agg")
    scene = jc.Scene()
    scene.add_body("arm", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.5, 0.0, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)))
    system, state = scene.build()
    axes = view.draw(system, state.q)
    assert len(axes.lines) == 1
    np.testing.assert_allclose(axes.lines[0].get_xdata(), [0.5, 0.0], atol=1e-12)
    view.pyplot().close(axes.figure)
