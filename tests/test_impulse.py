"""The response matrix of inequality rows, G = h J_b K J_bᵀ, compared with dense algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcon as jc

H = 2e-3


def scene(corners):
    """A box on a hinged arm with 12 velocities; `corners` of the box may touch the floor."""
    scene = jc.Scene()
    scene.add_body("arm", mass=1.5, inertia=(0.02, 0.1, 0.11), position=(0.5, 0.0, 0.3))
    scene.add_body("box", inertia=jc.inertia.box(2.0, (0.4, 0.3, 0.1)), position=(1.0, 0.0, 0.3))
    scene.add(jc.Spherical("shoulder", jc.WORLD, "arm", point=(0.0, 0.0, 0.3)))
    scene.add(jc.Revolute("wrist", "arm", "box", point=(1.0, 0.0, 0.3), axis=(0, 1, 0)))
    for k in range(corners):
        place = (1.0 + 0.2 * (-1) ** k, 0.15 * (-1) ** (k // 2), 0.25)
        scene.add(jc.PlaneContact(f"{k}", jc.WORLD, "box", center=place, friction=0.5))
    return scene.build()


@pytest.mark.parametrize("corners", [2, 5], ids=["by rows", "by velocities"])
@pytest.mark.parametrize(
    "solver", [jc.solvers.Sparse(), jc.solvers.Schur()], ids=["Sparse", "Schur"]
)
def test_the_matrix_is_that_of_dense_algebra(corners, solver):
    system, state = scene(corners)
    method = jc.Method(solver=solver)
    state = jc.init(system, method, state.q, jnp.linspace(-1, 1, len(state.v)))

    @jax.jit
    def found():
        impulse = begun(system, method, state)
        known, rows = impulse.saddle, impulse.rows.jacobian.dense()
        matrices = known.mass.dense(), known.jacobian.dense(), rows
        return impulse.matrix(), impulse.start, *matrices, known.force, known.target

    matrix, start, mass, equal, j, force, target = map(np.asarray, found())
    n, m = len(mass), len(equal)
    whole = np.block([[mass, -equal.T], [equal, np.zeros((m, m))]])
    response = np.linalg.solve(whole, np.vstack([j.T, np.zeros((m, len(j)))]))[:n]
    expected = H * j @ response
    np.testing.assert_allclose(matrix, expected, atol=1e-11 * np.abs(expected).max())
    free = np.linalg.solve(whole, np.concatenate([force, target]))[:n]
    np.testing.assert_allclose(start, free, atol=1e-10 * np.abs(free).max())


def test_fewer_velocities_than_rows_are_enough():
    """With more rows than velocities, the joints are solved once for each velocity."""
    widths, method = [], jc.Method(solver=jc.solvers.Sparse())
    for corners in (2, 5):
        system, state = scene(corners)
        known = jax.eval_shape(lambda s, own=system: begun(own, method, s).answers, state)
        widths.append(known.shape[1])
    assert widths == [6, 12]


def begun(system, method, state):
    """Returns the contact problem of a step from a state."""
    dt, at = jnp.asarray(H), (state.q, state.v, state.time)
    dynamics = method.dynamics(system, state, None, dt)
    rows = dynamics.linearize(*at)
    equations = dynamics.stabilizer.constraint_equations(rows, (), dt)
    problem = dynamics.assemble(equations, *at)
    return dynamics.contact._impulse(
        dynamics, (state.q, state.v), rows.inequalities, problem, dt, None, True
    )
