"""Derivatives of substeps: reverse = forward = finite difference, with plastic flow and contact at work."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from squeezed_block import FLOOR, GRID, one_substep, squeezed

from rewax.physics import mpm
from rewax.physics.mpm import FixedCorotated, Hencky, NeoHookean, VonMises
from rewax.physics.mpm.walls import Wall, WallKind


def assert_active(scene, state, poses):
    """Some particles flow and some do not; the collider and the wall each change node velocities."""
    F, _ = mpm.deform(scene, state)
    flows = np.any(np.abs(F - state.F) > 1e-6, axis=(1, 2))
    assert flows.any() or scene.material.plasticity is None
    v = np.asarray(one_substep((scene, state, poses)).v)
    far = poses._replace(position=poses.position + 10.0)
    assert np.abs(np.asarray(one_substep((scene, state, far)).v) - v).max() > 1e-3
    falls_on_wall = (state.x[:, 1] < FLOOR + 0.5 * GRID.spacing) & (state.v[:, 1] < 0)
    assert scene.walls.lower[1] is None or falls_on_wall.any()
    return flows


def output_weights(random_like, seed, out):
    """A random cotangent in which x, v, C and F count alike."""
    noise = random_like(seed, out)
    return jax.tree.map(lambda n, o: n / (jnp.sqrt(jnp.mean(o**2)) + 1e-12), noise, out)


def moves_of_each_leaf(random_like, args):
    """(name, direction) for every leaf: random, as large as the leaf; in all others zero."""
    leaves, treedef = jax.tree_util.tree_flatten_with_path(args)
    for index, (path, leaf) in enumerate(leaves):
        size = jnp.maximum(jnp.sqrt(jnp.mean(leaf**2)), 1e-3)
        if path[0].idx == 2:
            size = 0.03 * size  # a pose moves a body's velocity by 1 / dt times as much
        move = [jnp.zeros_like(other) for _, other in leaves]
        move[index] = size * random_like(index, leaf)
        yield jax.tree_util.keystr(path), treedef.unflatten(move)


SLIDING = (
    Hencky, VonMises, "capsule", Wall(position=FLOOR, kind=WallKind.SEPARATING, friction=0.3)
)  # fmt: skip
GRIPPED = (FixedCorotated, None, "box", Wall(position=FLOOR, kind=WallKind.GRIPPING))
LAWS = [
    pytest.param(SLIDING, marks=pytest.mark.slow, id="hencky"),
    pytest.param(GRIPPED, marks=pytest.mark.slow, id="fixed_corotated"),
    pytest.param(
        (NeoHookean, VonMises, "cylinder", Wall(position=FLOOR, kind=WallKind.SLIP)),
        marks=pytest.mark.slow, id="neo_hookean",
    ),
]  # fmt: skip


@pytest.mark.parametrize("case", LAWS)
def test_one_substep_reverse_forward_and_finite_difference_agree(x64, random_like, central_difference, inner, case):
    """With respect to every leaf: particles, material, gravity, poses of the body, friction, softness, sizes."""
    args = squeezed(*case)
    flows = assert_active(*args)
    assert case[1] is None or not flows.all()
    out, back = jax.vjp(one_substep, args)
    cotangent = output_weights(random_like, 0, out)
    (gradient,) = back(cotangent)
    everything = [move for _, move in moves_of_each_leaf(random_like, args)]
    everything = jax.tree.map(lambda *a: sum(a), *everything)
    _, tangent = jax.jvp(one_substep, (args,), (everything,))
    assert inner(gradient, everything) == pytest.approx(inner(cotangent, tangent), rel=1e-9)
    moved, errors = {}, {}
    for name, move in moves_of_each_leaf(random_like, args):
        reverse = inner(gradient, move)
        difference = inner(central_difference(one_substep, args, move, 3e-6), cotangent)
        moved[name] = reverse
        errors[name] = abs(reverse - difference) / max(abs(difference), 1e-3)
    print(case[0].__name__, {name: f"{error:.1e}" for name, error in errors.items()})
    assert [name for name, value in moved.items() if value == 0.0] == []
    assert max(errors.values()) < 1e-6, errors


MANY = 50


def test_fifty_substeps_with_plastic_flow_and_contact(x64, random_like, least_error, derivatives, inner):
    """Reverse = forward = finite difference within 1e-4 for each leaf; jit = eager; repeats are bit-identical."""
    args = squeezed(*SLIDING, num_substeps=MANY)
    zero = jax.tree.map(jnp.zeros_like, args)
    program = derivatives(lambda a: mpm.step(*a))

    def weights(end):
        return output_weights(random_like, 1, end)

    def simulate(args):
        return program(args, zero, weights=weights)[0]

    end = simulate(args)
    last = jax.tree.map(lambda p: p[-2:], args[2])
    flows = assert_active(args[0], end, last)
    assert flows.any() and float(jnp.abs(end.x - args[1].x).max()) > 0.01

    eager = args[1]
    for t in range(MANY):
        eager = one_substep((args[0], eager, jax.tree.map(lambda p, t=t: p[t : t + 2], args[2])))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10), end, eager)

    first, again = (program(args, zero, weights=weights) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    _, _, cotangent, gradient = first
    errors, modes = {}, {}
    for name, move in moves_of_each_leaf(random_like, args):
        tangent = program(args, move, weights=weights)[1]
        forward, reverse = inner(cotangent, tangent), inner(gradient, move)
        # The best of four steps: contact sets in abruptly at single nodes, which spoils a difference across it, and
        # 50 substeps amplify rounding, which spoils a short one. A wrong derivative disagrees with all.
        steps = (3e-6, 1e-6, 3e-7, 1e-7)
        errors[name] = least_error(simulate, args, move, cotangent, reverse, steps=steps, bar=1e-4)
        modes[name] = abs(reverse - forward) / max(abs(forward), 1e-3)
    print("50 substeps", {name: f"{error:.1e}" for name, error in errors.items()})
    assert max(modes.values()) < 1e-8, modes
    assert max(errors.values()) < 1e-4, errors


def test_store_every_changes_memory_and_not_results(x64, random_like):
    """Storing every other substep or everything: the same values and gradients (1 is compared with differences above)."""
    scene, state, poses = squeezed(FixedCorotated, None, "capsule", None, num_substeps=4)
    scene = scene.replace(colliders=())
    cotangent = random_like(0, state)

    def gradient(store_every):
        def simulate(scene, state):
            return mpm.step(scene, state, poses, store_every=store_every)

        out, back = jax.vjp(simulate, scene, state)
        return out, back(cotangent)

    every_two, all_of_it = (jax.jit(gradient, static_argnums=0)(k) for k in (2, None))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10), every_two, all_of_it)
    assert float(jnp.abs(every_two[1][1].F).max()) > 0


def test_environments_do_not_see_each_other(x64, random_like):
    """Values and gradients of an env depend neither on its place in the batch nor, by a bit, on env 1 being NaN."""
    scene, state, poses = squeezed(*GRIPPED)
    scene = scene.replace(colliders=())
    num_envs = 3
    noise = random_like(0, jax.tree.map(lambda a: jnp.zeros((num_envs, *a.shape)), state))
    states = jax.tree.map(lambda a, n: a + 1e-3 * n, state, noise)
    cotangents = random_like(1, states)

    def back(state, cotangent):
        out, pull = jax.vjp(lambda scene, state: one_substep((scene, state, poses)), scene, state)
        return out, pull(cotangent)

    together = jax.vmap(back)
    fine = together(states, cotangents)
    turned = together(*jax.tree.map(lambda a: jnp.roll(a, 1, axis=0), (states, cotangents)))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(jnp.roll(a, 1, axis=0), b), fine, turned)
    poisoned = together(states.replace(x=states.x.at[1, 3].set(jnp.nan), F=states.F.at[1].set(jnp.nan)), cotangents)
    assert np.isnan(poisoned[0].v[1]).any() and np.isnan(poisoned[1][1].v[1]).any()
    for env in (0, 2):
        jax.tree.map(lambda a, b, e=env: np.testing.assert_array_equal(a[e], b[e]), poisoned, fine)
