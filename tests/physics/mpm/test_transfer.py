"""The transfers against a reference that visits every particle and every node of the grid."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rewax.physics.mpm import transfer
from rewax.physics.mpm.active_nodes import count_nodes, list_nodes
from rewax.physics.mpm.grid import Grid
from rewax.physics.numerics import components as cp

GRID = Grid(shape=(7, 8, 6), spacing=0.1, origin=(-0.1, 0.2, 0.0))
NUM = 24
TOLERANCE = {np.float32: 1e-5, np.float64: 1e-12}


# --- The reference: dense weights on all nodes, autodiff for derivatives -----------------------------------------------


def dense_weights(x):
    """Weight of every node for one particle at x (3,), shape grid.shape, and offsets (*grid.shape, 3)."""

    def along(axis):
        u = jnp.abs(GRID.axis_nodes(axis) - x[axis]) / GRID.spacing
        return jnp.where(u < 0.5, 0.75 - u**2, jnp.where(u < 1.5, 0.5 * (1.5 - u) ** 2, 0.0))

    nodes = np.stack(np.meshgrid(*(GRID.axis_nodes(a) for a in range(3)), indexing="ij"), -1)
    w = along(0)[:, None, None] * along(1)[None, :, None] * along(2)[None, None, :]
    return w.astype(x.dtype), nodes.astype(x.dtype) - x


def scatter_one(x, mass, p, A):
    w, d = dense_weights(x)
    return w * mass, w[..., None] * (p + d @ A.T)


def plain_p2g(x, mass, p, A):
    masses, momenta = jax.vmap(scatter_one)(x, mass, p, A)
    return jnp.sum(masses, 0), jnp.sum(momenta, 0)


def interpolate_one(x, v):
    w, d = dense_weights(x)
    return jnp.sum(w[..., None] * v, (0, 1, 2)), jnp.einsum("xyz,xyzi,xyzj->ij", w, v, d, precision="highest")


def plain_g2p(x, v):
    return jax.vmap(interpolate_one, (0, None))(x, v)


# --- The same signature around the transfers under test ---------------------------------------------------------------


def p2g(x, mass, p, A):
    fields = transfer.particle_to_grid(GRID, cp.split_vector(x), mass, cp.split_vector(p), cp.split_matrix(A))
    return fields.mass.reshape(GRID.shape), cp.join_vector(fields.momentum).reshape(*GRID.shape, 3)


def g2p(x, v):
    velocity, moment = transfer.grid_to_particle(GRID, cp.split_vector(x), cp.split_vector(v.reshape(-1, 3)))
    return cp.join_vector(velocity), cp.join_matrix(moment)


NUM_ACTIVE = 230


def active_nodes(x):
    """A list of nodes for particles at x, and the flat index of each, GRID.num_nodes where a place is not used."""
    active = list_nodes(GRID, x, NUM_ACTIVE)
    used = jnp.arange(NUM_ACTIVE) < count_nodes(GRID, x)
    return active, jnp.where(used, jnp.ravel_multi_index(active.index, GRID.shape, mode="clip"), GRID.num_nodes)


def p2g_active(x, mass, p, A):
    particles = cp.split_vector(x), mass, cp.split_vector(p), cp.split_matrix(A)
    fields = transfer.particle_to_grid(GRID, *particles, active=active_nodes(x)[0])
    return fields.mass, cp.join_vector(fields.momentum)


def plain_p2g_active(x, mass, p, A):
    masses, momenta = plain_p2g(x, mass, p, A)
    rows = jnp.concatenate([masses.reshape(-1, 1), momenta.reshape(-1, 3)], axis=1)
    rows = rows.at[active_nodes(x)[1]].get(mode="fill", fill_value=0)
    return rows[:, 0], rows[:, 1:]


def g2p_active(x, v):
    velocity, moment = transfer.grid_to_particle(
        GRID, cp.split_vector(x), cp.split_vector(v), active=active_nodes(x)[0]
    )
    return cp.join_vector(velocity), cp.join_matrix(moment)


def plain_g2p_active(x, v):
    nodes = jnp.zeros((GRID.num_nodes, 3), v.dtype).at[active_nodes(x)[1]].set(v, mode="drop")
    return plain_g2p(x, nodes.reshape(*GRID.shape, 3))


CASES = {
    "p2g": (p2g, plain_p2g),
    "g2p": (g2p, plain_g2p),
    "p2g active": (p2g_active, plain_p2g_active),
    "g2p active": (g2p_active, plain_g2p_active),
}


def arguments(name: str, dtype, seed: int = 0, batch: tuple[int, ...] = ()):
    rng = np.random.default_rng(seed)
    lower, upper = np.array(GRID.lower), np.array(GRID.upper)
    if "active" in name:
        upper = lower + 0.5 * (upper - lower)  # a body that fills an eighth of the box, at its lower corner
    x = rng.uniform(lower, upper, (*batch, NUM, 3))
    if name.startswith("g2p"):
        nodes = (NUM_ACTIVE,) if "active" in name else GRID.shape
        args = (x, rng.standard_normal((*batch, *nodes, 3)))
    else:
        args = (x, rng.uniform(0.5, 1.5, (*batch, NUM)), rng.standard_normal((*batch, NUM, 3)))
        args = (*args, 10.0 * rng.standard_normal((*batch, NUM, 3, 3)))
    return tuple(jnp.asarray(a, dtype) for a in args)


def value_and_cotangents(f, args, cotangent):
    value, back = jax.vjp(f, *args)
    return value, back(cotangent)


def everything(f, args, tangents, cotangent):
    value, tangent = jax.jvp(f, args, tangents)
    return value, jax.vjp(f, *args)[1](cotangent), tangent


EVERYTHING = jax.jit(everything, static_argnums=0)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("name", CASES)
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), snapped=st.sampled_from([0.0, 0.5]))
def test_values_and_derivatives_equal_the_reference(x64, random_like, relative_error, name, dtype, seed, snapped):
    """Anywhere between the nodes, and exactly on them and midway, where stencils change."""
    mine, plain = CASES[name]
    x, *rest = arguments(name, dtype, seed)
    half_cells = np.round((np.asarray(x) - GRID.origin) / (0.5 * GRID.spacing))
    on_knots = np.clip(GRID.origin + 0.5 * GRID.spacing * half_cells, GRID.lower, GRID.upper)
    snap = np.random.default_rng(seed).random((NUM, 1)) < snapped
    args = (jnp.asarray(np.where(snap, on_knots, x), dtype), *rest)
    tangents, cotangent = random_like(2, args), random_like(1, jax.eval_shape(mine, *args))
    got, want = (EVERYTHING(f, args, tangents, cotangent) for f in (mine, plain))
    for mine_leaf, plain_leaf in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert mine_leaf.dtype == dtype
        assert relative_error(mine_leaf, plain_leaf) < TOLERANCE[dtype]


@pytest.mark.parametrize("name", CASES)
def test_derivative_by_one_argument_alone(x64, random_like, relative_error, name):
    """The others carry no tangent at all, which takes other paths through the rules."""
    mine, plain = CASES[name]
    args = arguments(name, np.float64)
    tangents, cotangent = random_like(2, args), random_like(1, jax.eval_shape(mine, *args))
    gradient = jax.jit(lambda *a: jax.vjp(plain, *a)[1](cotangent))(*args)
    plain_jvp = jax.jit(lambda *t: jax.jvp(plain, args, t)[1])
    for index, argument in enumerate(args):

        def alone(a, i=index):
            return mine(*args[:i], a, *args[i + 1 :])

        assert relative_error(jax.vjp(alone, argument)[1](cotangent)[0], gradient[index]) < 1e-12
        only = (t if i == index else jnp.zeros_like(t) for i, t in enumerate(tangents))
        got = jax.jvp(alone, (argument,), (tangents[index],))[1]
        assert relative_error(got, plain_jvp(*only)) < 1e-12


@pytest.mark.parametrize(
    ("name", "axes"),
    [
        ("p2g", (0, 0, 0, 0)),
        ("p2g", (None, 1, None, 0)),
        ("g2p", (0, None)),
        ("g2p", (None, 0)),
        ("p2g active", (0, 0, 0, 0)),
        ("g2p active", (0, 0)),
    ],
)
def test_vmap_equals_a_loop_and_grad_of_vmap_is_vmap_of_grad(x64, random_like, relative_error, name, axes):
    mine, plain = CASES[name]
    num_envs = 3
    one, batched = arguments(name, np.float64), arguments(name, np.float64, 5, (num_envs,))
    args = tuple(o if axis is None else jnp.moveaxis(b, 0, axis) for o, b, axis in zip(one, batched, axes, strict=True))
    cotangent = random_like(1, jax.eval_shape(jax.vmap(mine, axes), *args))
    value, together = value_and_cotangents(jax.vmap(mine, axes), args, cotangent)
    _, per_env = jax.vmap(lambda ct, *a: value_and_cotangents(mine, a, ct), (0, *axes))(cotangent, *args)
    reference = jax.jit(functools.partial(value_and_cotangents, plain))
    for env in range(num_envs):
        alone = tuple(a if axis is None else jnp.take(a, env, axis) for a, axis in zip(args, axes, strict=True))
        want, gradient = reference(alone, jax.tree.map(lambda c, e=env: c[e], cotangent))
        assert relative_error(jax.tree.map(lambda v, e=env: v[e], value), want) < 1e-12
        assert relative_error(jax.tree.map(lambda g, e=env: g[e], per_env), gradient) < 1e-12
    for total, each, axis in zip(together, per_env, axes, strict=True):
        want = jnp.sum(each, 0) if axis is None else jnp.moveaxis(each, 0, axis)
        assert relative_error(total, want) < 1e-12


@pytest.mark.parametrize("name", ["p2g", "g2p"])
def test_nested_vmap(x64, random_like, relative_error, name):
    """Over two axes, the inner one only for the positions."""
    mine, plain = CASES[name]
    x, *rest = arguments(name, np.float64, 7, (2, 3))
    args = (x, *(a[:, 0] for a in rest))
    inner = (0, *(None for _ in rest))
    cotangent = random_like(1, jax.eval_shape(jax.vmap(jax.vmap(mine, inner)), *args))
    got, want = (
        jax.jit(functools.partial(value_and_cotangents, jax.vmap(jax.vmap(f, inner))))(args, cotangent)
        for f in (mine, plain)
    )
    assert relative_error(got, want) < 1e-12


@pytest.mark.parametrize("dtype", TOLERANCE)
def test_mass_momentum_and_angular_momentum_pass_unchanged(x64, dtype):
    """To the grid: mass, momentum, and angular momentum with the affine part's share dx^2/4 axial(A)."""
    x, mass, p, A = arguments("p2g", dtype)
    node_mass, node_momentum = (np.asarray(a, np.float64) for a in p2g(x, mass, p, A))
    eps = 20 * np.finfo(dtype).eps
    np.testing.assert_allclose(node_mass.sum(), np.asarray(mass, np.float64).sum(), rtol=eps)
    size = np.abs(p).sum()
    np.testing.assert_allclose(node_momentum.sum((0, 1, 2)), np.asarray(p, np.float64).sum(0), atol=eps * size)
    nodes = np.stack(np.meshgrid(*(GRID.axis_nodes(a) for a in range(3)), indexing="ij"), -1)
    axial = np.stack([A[:, 2, 1] - A[:, 1, 2], A[:, 0, 2] - A[:, 2, 0], A[:, 1, 0] - A[:, 0, 1]], -1)
    before = (np.cross(x, p) + GRID.spacing**2 / 4 * axial).sum(0)
    np.testing.assert_allclose(np.cross(nodes, node_momentum).sum((0, 1, 2)), before, atol=eps * size)


def test_affine_velocity_fields_survive_exactly(x64):
    """v(x) = a + B x on the nodes arrives as v at the particle and B as its gradient."""
    x, _ = arguments("g2p", np.float64)
    rng = np.random.default_rng(3)
    a, B = rng.standard_normal(3), rng.standard_normal((3, 3))
    nodes = np.stack(np.meshgrid(*(GRID.axis_nodes(i) for i in range(3)), indexing="ij"), -1)
    velocity, moment = g2p(x, jnp.asarray(a + nodes @ B.T))
    np.testing.assert_allclose(velocity, a + np.asarray(x) @ B.T, atol=1e-13)
    np.testing.assert_allclose(4 / GRID.spacing**2 * moment, np.broadcast_to(B, (NUM, 3, 3)), atol=1e-11)


def test_second_derivatives_are_refused_with_the_reason():
    x, v = arguments("g2p", np.float32)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        jax.make_jaxpr(jax.hessian(lambda s: jnp.sum(g2p(x * s, v)[0] ** 2)))(1.0)
