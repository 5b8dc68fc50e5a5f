"""Contact of cloth and ropes with themselves: forces by hand, conservation, derivatives, layers that stay apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import SHEET, cloth_scene, rope_scene, shaken

from rewax.lowering import portable
from rewax.physics import thin
from rewax.physics.thin.contact_elements import near_vertices, tree_order
from rewax.status import Status


def law(**changes):
    """Built in the test, so that its numbers have the test's precision."""
    given = {"thickness": 0.02, "stiffness": 50.0, "damping": 0.05, "friction": 0.4, "friction_damping": 0.05}
    return thin.SelfContact(**given | {"max_speed": 0.5, "every": 4} | changes)


FORCE = jax.jit(thin.self_contact_force)
RUN = jax.jit(thin.step, static_argnames="store_every")


def two(points, kind):
    """A triangle with another above it, or two ropes of one segment."""
    points = np.asarray(points, float)
    if kind == "cloth":
        mesh = thin.ThinMesh(vertices=points, triangles=np.asarray([[0, 1, 2], [3, 4, 5]], np.int32))
        return cloth_scene(mesh, dt=1e-5, self_contact=law(max_speed=0.1))
    mesh = thin.ThinMesh(vertices=points, segments=np.asarray([[0, 1], [2, 3]], np.int32))
    return rope_scene(mesh, dt=1e-5, self_contact=law(max_speed=0.1))


FLOOR = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.3], [0.3, 0.0, 0.0]]


@pytest.mark.parametrize("depth", [0.002, 0.012])
def test_a_vertex_above_a_triangle_is_pushed_with_the_force_of_its_depth(x64, depth):
    """k c^2 / (2 o) up to c = o = h / 4, k (c - o / 2) beyond; the corners share it by barycentric coordinates."""
    height = 0.02 - depth
    points = np.asarray([*FLOOR, [0.06, height, 0.09], [0.0, 0.5, 0.3], [0.3, 0.5, 0.0]])
    force = FORCE(two(points, "cloth"), thin.initial_state(points))
    onset = 0.005
    expected = 50.0 * (depth**2 / (2 * onset) if depth < onset else depth - onset / 2)
    np.testing.assert_allclose(force[3], [0.0, expected, 0.0], atol=1e-12)
    np.testing.assert_allclose(force[:3, 1], -expected * np.array([0.5, 0.3, 0.2]), atol=1e-12)


def test_crossing_segments_push_each_other_at_their_middles_and_friction_is_coulombs(x64):
    points = np.asarray([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.01, -0.1], [0.0, 0.01, 0.1]])
    scene = two(points, "rope")
    state = thin.initial_state(points)
    push = 50.0 * (0.01 - 0.0025)
    np.testing.assert_allclose(FORCE(scene, state)[:, 1], push * np.array([-0.5, -0.5, 0.5, 0.5]), atol=1e-12)
    for speed, drag in ((0.1, 0.05 * 0.1), (100.0, 0.4 * push)):
        sliding = state.replace(v=state.v.at[2:, 0].set(speed))
        np.testing.assert_allclose(FORCE(scene, sliding)[2:, 0].sum(), -drag, rtol=1e-9)


def folded(seed=0, size=0.001, **changes):
    """A sheet folded on itself with its halves within the thickness, shaken."""
    mesh = thin.sheet(0.4, 0.2, 8, 4)
    x = np.array(mesh.vertices)
    back = x[:, 0] > 0.21
    x[back] = np.stack([0.40155 - x[back, 0], np.full(back.sum(), 0.012), x[back, 2] + 0.003], axis=-1)
    state = shaken(mesh, size=size, speed=0.1, seed=seed)
    scene = cloth_scene(mesh, dt=1e-4, self_contact=law(thickness=0.015, **changes))
    limp = scene.replace(cloth=scene.cloth.replace(bending=1e-6))  # else the fold springs open
    return limp, state.replace(
        x=state.x - mesh.vertices + x
    )


def test_forces_and_torques_without_friction_sum_to_zero_and_equal_those_of_all_pairs(x64):
    scene, state = folded()
    force = FORCE(scene, state)
    scale = float(jnp.abs(force).max())
    assert scale > 0.05 and thin.check_status(scene, state) & Status.FULL_PAIRS == 0
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-12 * scale)
    slippery = scene.replace(self_contact=scene.self_contact.replace(friction=jnp.asarray(0.0)))
    turning = np.cross(state.x, FORCE(slippery, state)).sum(axis=0)
    np.testing.assert_allclose(turning, 0.0, atol=1e-12 * scale)
    # Friction acts at both closest points: its torque is at most the distance times its force.
    rubbing = np.abs(force - FORCE(slippery, state)).sum()
    assert 0.0 < np.linalg.norm(np.cross(state.x, force).sum(axis=0)) < 0.015 * rubbing
    with portable():
        in_jax = jax.jit(lambda scene, state: thin.self_contact_force(scene, state))(scene, state)
    np.testing.assert_allclose(in_jax, force, atol=1e-11 * scale)
    wide = scene.replace(self_contact=scene.self_contact.replace(max_speed=100.0, pairs_per_element=400))
    np.testing.assert_allclose(FORCE(wide, state), force, atol=1e-12 * scale)


def measured(scene, state):
    end = thin.step(scene, state, thin.static_poses(8, dtype=state.x.dtype), store_every=4)
    weights = jnp.cos(jnp.arange(end.x.size)).reshape(end.x.shape)
    return jnp.sum(weights * (end.x + 0.1 * end.v))


def test_reverse_is_forward_is_finite_difference_in_self_contact(x64):
    scene, state = folded()
    slopes = jax.jit(jax.grad(measured, argnums=(0, 1)))(scene, state)
    forward = jax.jit(lambda args, along: jax.jvp(measured, args, along)[1])
    value, rng = jax.jit(measured), np.random.default_rng(2)
    zero = jax.tree.map(jnp.zeros_like, (scene, state))
    changed = jax.tree.map(lambda a: a * (1.0 + 0.5 * rng.random()), scene.self_contact).replace(max_speed=0.0)
    noise = jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(a.shape)), state)
    for name, along in {"law": (zero[0].replace(self_contact=changed), zero[1]), "state": (zero[0], noise)}.items():
        reverse = sum(float(jnp.sum(a * b)) for a, b in zip(*map(jax.tree.leaves, (slopes, along)), strict=True))
        ends = [value(*jax.tree.map(lambda a, d, s=s: a + s * 1e-7 * d, (scene, state), along)) for s in (1.0, -1.0)]
        assert abs(reverse) > 1e-7, name
        np.testing.assert_allclose(reverse, forward((scene, state), along), rtol=1e-9, err_msg=name)
        np.testing.assert_allclose(reverse, float(ends[0] - ends[1]) / 2e-7, rtol=1e-4, err_msg=name)


def crossings(mesh, x):
    """Number of edges that pass through a triangle with which they share no vertex, in NumPy: all pairs."""
    edges = np.unique(np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    i, j = (k.reshape(-1) for k in np.indices((len(edges), len(mesh.triangles))))
    apart = ~(edges[i][:, :, None] == mesh.triangles[j][:, None, :]).any(axis=(1, 2))
    (p, q), (a, b, c) = x[edges[i[apart]]].swapaxes(0, 1), x[mesh.triangles[j[apart]]].swapaxes(0, 1)

    def volume(u, v, w, z):
        return np.einsum("na,na->n", np.cross(v - u, w - u), z - u)

    around = np.stack([volume(p, q, *pair) for pair in ((a, b), (b, c), (c, a))])
    through = (around > 0).all(axis=0) | (around < 0).all(axis=0)
    return int(np.sum(through & (volume(a, b, c, p) * volume(a, b, c, q) < 0)))


@pytest.mark.parametrize("apart", [True, False])
def test_halves_thrown_at_each_other_cross_only_without_self_contact(x64, apart):
    scene, state = folded(size=1e-4, max_speed=0.9)
    mesh = thin.sheet(0.4, 0.2, 8, 4)
    above = jnp.asarray(np.asarray(mesh.vertices)[:, 0] > 0.21)
    start = state.replace(v=jnp.where(above[:, None], jnp.array([0.0, -0.25, 0.0]), jnp.array([0.0, 0.25, 0.0])))
    assert crossings(mesh, np.asarray(start.x)) == 0
    scene = scene if apart else scene.replace(self_contact=None)
    most, poses = 0, thin.static_poses(40, dtype=float)
    for _ in range(25):
        start = RUN(scene, start, poses)
        most = max(most, crossings(mesh, np.asarray(start.x)))
        if apart and most:
            break
    assert (most == 0) == apart
    if apart:
        assert int(thin.check_status(scene, start)) & Status.CROSSED == 0


def test_status_names_crossed_layers_speed_and_full_lists(x64):
    scene, state = folded()
    assert thin.check_status(scene, state) == 0
    fast = state.replace(v=state.v.at[0, 1].set(2.0))
    assert thin.check_status(scene, fast) == Status.CROSSED
    moving = state.replace(v=state.v + jnp.array([5.0, 0.0, 0.0]))  # all alike: nothing comes closer
    assert thin.check_status(scene, moving) == 0
    through = state.x.at[40:, 1].add(jnp.where(jnp.arange(5) % 2 == 0, -0.03, 0.0))
    assert crossings(thin.sheet(0.4, 0.2, 8, 4), np.asarray(through)) > 0
    assert thin.check_status(scene, state.replace(x=through)) & Status.CROSSED
    few = scene.replace(self_contact=scene.self_contact.replace(pairs_per_element=1, thickness=0.1))
    assert thin.check_status(few, state) & Status.FULL_PAIRS


def test_a_batch_is_a_loop_and_float32_is_near(x64):
    scene, _ = folded()
    states = [folded(seed)[1] for seed in (0, 1)]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *states)
    batch = jax.jit(jax.vmap(thin.self_contact_force, in_axes=(None, 0)))(scene, stacked)
    for each, state in zip(batch, states, strict=True):
        np.testing.assert_allclose(each, FORCE(scene, state), atol=1e-13)
    narrow = jax.tree.map(lambda a: a.astype(jnp.float32), (scene, states[0]))
    small = FORCE(*narrow)
    assert small.dtype == jnp.float32
    np.testing.assert_allclose(small, batch[0], atol=1e-4)


def test_neighbours_are_near_along_the_mesh_and_trees_hold_every_element_once():
    edges = np.asarray([[0, 1], [1, 2], [2, 3]])
    points = np.asarray([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [4.0, 0, 0]])
    assert near_vertices(edges, points, 2.0) == [{0, 1, 2}, {0, 1, 2}, {0, 1, 2, 3}, {2, 3}]
    order = tree_order(np.random.default_rng(0).random((21, 3)), 16)
    assert len(order) == 32 and sorted(order) == [-1] * 11 + list(range(21))


REFUSED = [
    ({"thickness": -1.0}, "self_contact.thickness is -1.0"),
    ({"thickness": 0.06}, "more than half of the smallest height"),
    ({"max_speed": 100.0}, "self_contact.max_speed is 100"),
    ({"stiffness": 1e7}, "above the largest stable"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_illegal_self_contact_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        cloth_scene(SHEET, self_contact=law(**changes))
