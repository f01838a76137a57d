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


def test_an_animation_moves_the_lines_of_a_drawing_and_its_axes_hold_all_of_them(tmp_path):
    from PIL import Image

    system, state = scenes.four_bar()
    path = jc.rollout(system, jc.Method(), state, None, 5e-3, 60, every=20)[1].q
    animation = view.animate(system, path, 0.1)
    axes = animation._fig.axes[0]
    for i, q in enumerate(path):
        animation._func(i)
        for line, points in zip(axes.lines, view.links(system, q).values(), strict=True):
            np.testing.assert_array_equal(line.get_xydata(), points)
            inside = axes.transAxes.inverted().transform(axes.transData.transform(points))
            assert np.all((inside > 0) & (inside < 1))
    assert np.ptp(path, axis=0).max() > 0.1  # the scene moves
    animation.save(tmp_path / "motion.gif", writer="pillow")
    with Image.open(tmp_path / "motion.gif") as picture:
        assert picture.n_frames == 3


def test_an_animation_stays_in_axes_that_were_given(tmp_path):
    scene = jc.Scene()
    scene.add_body("arm", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.5, 0.0, 0.0))
    scene.add(jc.Revolute("hinge", jc.WORLD, "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)))
    system, state = scene.build()
    axes = view.canvas(3.0, 3.0, 50).figure.add_subplot(xlim=(-2.0, 2.0), ylim=(-2.0, 2.0))
    (ground,) = axes.plot([-2.0, 2.0], [0.0, 0.0])
    axes.set_autoscale_on(False)
    animation = view.animate(system, [state.q, state.q], 0.1, axes, color="k")
    animation.save(tmp_path / "still.gif", writer="pillow")
    assert axes.get_xlim() == (-2.0, 2.0)
    np.testing.assert_array_equal(ground.get_xdata(), [-2.0, 2.0])
    assert axes.lines[1].get_color() == "k"
