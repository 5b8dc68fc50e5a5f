"""The implicit step: its equation, its agreement with the explicit one, its derivatives."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from implicit_cases import CASES, TIGHT, known, met, noise, touched
from thin_bodies import LINE, SHEET, cloth_scene, rope_scene, run

from rewax.physics import thin
from rewax.physics.numerics import components as cp
from rewax.physics.thin import implicit_step, newton


@pytest.mark.parametrize("kind", CASES)
def test_the_curvature_is_the_derivative_of_the_slope_and_its_approximation_is_positive(x64, kind):
    scene, state, poses = CASES[kind]()
    there = known(scene, state, poses)
    x = cp.vector(lambda i: state.x[:, i] + 0.002 * jnp.sin(7.0 * jnp.arange(len(state.x)) + i))
    p, q = noise(x, 1), noise(x, 2)

    def products(exact):
        matrix = implicit_step.curvature(scene, there, x, exact)
        return matrix(p), matrix(q)

    along, across = jax.jit(products)(jnp.ones(()))
    expected = jax.jit(lambda: jax.jvp(lambda x: implicit_step.slope(scene, there, x), (x,), (p,))[1])()
    scale = float(jnp.abs(jnp.stack(expected)).max())
    np.testing.assert_allclose(jnp.stack(along), jnp.stack(expected), atol=1e-9 * scale)
    np.testing.assert_allclose(newton.inner(along, q), newton.inner(across, p), rtol=1e-9)
    matrix = jax.jit(
        jax.vmap(
            lambda flat: jnp.stack(
                implicit_step.curvature(scene, there, x, jnp.zeros(()))(cp.split_vector(flat.reshape(-1, 3))), axis=-1
            ).reshape(-1)
        )
    )
    H = np.asarray(matrix(jnp.eye(state.x.size)))
    np.testing.assert_allclose(H, H.T, atol=1e-9 * scale)
    assert np.linalg.eigvalsh(H)[0] > 0.9 * float(scene.mass.min()) / scene.dt**2
    found = jax.jit(lambda: implicit_step.blocks(scene, implicit_step.reach(scene), there, x))()
    own = H.reshape(len(state.x), 3, len(state.x), 3)[np.arange(len(state.x)), :, np.arange(len(state.x))]
    if kind in ("rope", "self-contact"):  # the others are dominated by the bound of bending
        bending = implicit_step.reach(scene)
        for i in range(3):
            np.testing.assert_allclose(found.diagonal[i] - bending, own[:, i, i], rtol=0.1)
            np.testing.assert_allclose(found.mixed[i], own[:, (i + 1) % 3, (i + 2) % 3], atol=0.1 * own[:, i, i].max())


@pytest.mark.parametrize("kind", ["cloth", "rope"])
def test_it_approaches_the_explicit_step_at_first_order(x64, kind):
    make, mesh = (cloth_scene, SHEET) if kind == "cloth" else (rope_scene, LINE)
    x = np.asarray(mesh.vertices)
    x = x * [1.02, 1.0, 1.0] + 0.02 * np.cos(9 * x[:, :1]) * [0, 1.0, 0]
    state = thin.initial_state(x)
    exact = run(make(mesh, dt=1e-5, damping=1e-4), state, 2000).x
    ends = [run(make(mesh, dt=4e-4 / n, damping=1e-4, stepper=TIGHT), state, 50 * n) for n in (1, 2, 4)]
    errors = [float(jnp.abs(end.x - exact).max()) for end in ends]
    assert all(1.6 < a / b < 2.4 for a, b in itertools.pairwise(errors)), errors
    assert all(thin.check_status(make(mesh, stepper=TIGHT), end) == 0 for end in ends)


def pushed(scene, state, pins, vertices, poses):
    """A number from two steps of a body whose rest shape is ``vertices``."""
    scene = scene.replace(rest=thin.rest_shape(scene.topology, vertices))
    twice = jax.tree.map(lambda a: jnp.concatenate([a, a[1:] + (a[1:] - a[:1]) * (a.ndim == 3)]), poses)
    end = thin.step(scene, state, twice, pins=pins)
    weights = jnp.cos(jnp.arange(end.x.size)).reshape(end.x.shape)
    return jnp.sum(weights * (end.x + 0.1 * end.v))


@pytest.mark.parametrize(
    ("kind", "bar"),
    [("StVK", 1e-4), ("hinges", 1e-4), ("neo-Hookean", 1e-4), ("rope", 1e-4), ("smooth", 1e-6), ("self-contact", 1e-4)],
)
def test_reverse_is_forward_is_finite_difference(x64, kind, bar):
    if kind == "self-contact":
        scene, state, poses = met()
    elif kind == "smooth":
        scene, state, poses = touched(contact=None, ground=None, colliders=())
    else:
        scene, state, poses = touched(kind)
    held = scene.topology.held.indices[:, 0]
    pins = jnp.broadcast_to(state.x[held], (2, len(held), 3)) + 0.001 if len(held) else None
    vertices = jnp.asarray(
        {"rope": LINE.vertices}.get(kind, SHEET.vertices)
        if kind != "self-contact"
        else thin.sheet(0.4, 0.2, 8, 4).vertices
    )
    args = (scene, state, pins, vertices)

    def value(*args):
        return pushed(*args, poses)

    value = jax.jit(value)
    slopes = jax.jit(jax.grad(value, argnums=(0, 1, 2, 3) if len(held) else (0, 1, 3)))(*args)
    slopes = slopes if len(held) else (*slopes[:2], None, slopes[2])
    forward = jax.jit(lambda args, along: jax.jvp(value, args, along)[1])
    rng = np.random.default_rng(1)
    zero = jax.tree.map(jnp.zeros_like, args)
    noisy = [jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(a.shape)), a) for a in args[1:]]
    law = None if scene.self_contact is None else scene.self_contact.replace(max_speed=0.0)
    parts = jax.tree.map(
        lambda a: a * (1.0 + 0.5 * rng.standard_normal(a.shape)), (scene.cloth, scene.rope, scene.contact, law)
    )
    names = dict(zip(("cloth", "rope", "contact", "self_contact"), parts, strict=True))
    directions = {
        "laws": (zero[0].replace(**{k: v for k, v in names.items() if v is not None}), *zero[1:]),
        "state": (zero[0], noisy[0], *zero[2:]),
        "rest shape": (*zero[:3], noisy[2]),
        **({"pins": (*zero[:2], noisy[1], zero[3])} if len(held) else {}),
    }
    for name, along in directions.items():
        reverse = sum(float(jnp.sum(a * b)) for a, b in zip(*map(jax.tree.leaves, (slopes, along)), strict=True))
        size = 1e-7
        ends = [value(*jax.tree.map(lambda a, d, s=s: a + s * size * d, args, along)) for s in (1, -1)]
        difference = float(ends[0] - ends[1]) / (2 * size)
        assert abs(reverse) > 1e-6, name
        np.testing.assert_allclose(reverse, forward(args, along), rtol=1e-8, err_msg=name)
        np.testing.assert_allclose(reverse, difference, rtol=bar, err_msg=name)
