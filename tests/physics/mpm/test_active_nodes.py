"""A step on active nodes only, against the same step on the whole grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material
from hypothesis import given, settings
from hypothesis import strategies as st

from rewax.physics import mpm
from rewax.physics.contact.colliders import Collider
from rewax.physics.mpm import Hencky, VonMises, active_nodes
from rewax.physics.mpm.active_nodes import REACHES, all_nodes, count_nodes, list_nodes
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.walls import Wall, WallKind, Walls
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Capsule
from rewax.status import Status

GRID = Grid(shape=(17, 14, 15), spacing=0.05, origin=(-0.2, 0.1, 0.3))
NUM, NUM_SUBSTEPS, DT = 30, 4, 1e-3
TIGHT = {"max_active_nodes": 750}


def make(dtype=np.float64, **options) -> mpm.MPMScene:
    scene = mpm.make_scene(
        grid=GRID,
        dt=DT,
        material=flat_material(
            youngs_modulus=1e4, poissons_ratio=0.3, density=1000.0, yield_stress=200.0,
            elasticity=Hencky, plasticity=VonMises,
        ),
        particle_volume=1e-5,
        colliders=(
            Collider(
                shape=Capsule(radius=0.04, half_length=0.1), offset=np.zeros(3), rotation=np.eye(3),
                friction=0.5, softness=50.0,
            ),
        ),
        walls=Walls(
            lower=(Wall(position=-0.1), Wall(position=0.18, kind=WallKind.STICKY), Wall(position=0.4, friction=0.3)),
            upper=(Wall(position=0.5), None, Wall(position=0.9)),
        ),
        **options,
    )  # fmt: skip
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), scene)


def body(seed: int, corner, dtype=np.float64) -> tuple[mpm.MPMState, Pose]:
    """Particles in a cube of 0.15 m at a relative place in the grid, moving, and a turning capsule in their middle."""
    rng = np.random.default_rng(seed)
    lower, upper = np.asarray(GRID.lower), np.asarray(GRID.upper)
    start = lower + np.asarray(corner) * (upper - lower - 0.15)
    x = start + 0.15 * rng.random((NUM, 3))
    state = mpm.MPMState(
        x=x,
        v=rng.normal(size=(NUM, 3)),
        C=rng.normal(size=(NUM, 3, 3)),
        F=np.eye(3) + 0.1 * rng.normal(size=(NUM, 3, 3)),
    )
    angle = 0.1 * np.arange(NUM_SUBSTEPS + 1)
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    rotation = np.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).reshape(-1, 1, 3, 3)
    position = (start + 0.05 + 0.002 * np.arange(NUM_SUBSTEPS + 1)[:, None])[:, None]
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), (state, Pose(position, rotation)))


def combination(inputs, weights):
    """All leaves after a step, and a random combination of them."""
    end = mpm.step(*inputs)
    return sum(jnp.vdot(a, w) for a, w in zip(jax.tree.leaves(end), weights, strict=True)), end


GRADIENT = jax.jit(jax.value_and_grad(combination, has_aux=True))
STEP = jax.jit(mpm.step)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), corner=st.tuples(*[st.floats(0.0, 1.0)] * 3))
def test_a_tight_step_equals_one_on_the_whole_grid(x64, relative_error, seed, corner):
    """Anywhere in the grid, also at its corners; values and gradients by state, poses, material and colliders."""
    state, poses = body(seed, corner)
    rng = np.random.default_rng(seed)
    weights = [jnp.asarray(rng.normal(size=a.shape)) for a in jax.tree.leaves(state)]
    (_, whole), whole_gradient = GRADIENT((make(), state, poses), weights)
    (_, tight), tight_gradient = GRADIENT((make(**TIGHT), state, poses), weights)
    assert int(mpm.check_status(make(**TIGHT), tight, start=state)) & Status.INACTIVE_NODES == 0
    assert relative_error(tight, whole) < 1e-12
    # Sums of large terms of both signs, and contact that amplifies: no digit less than the whole grid has.
    assert relative_error(jax.tree.leaves(tight_gradient), jax.tree.leaves(whole_gradient)) < 1e-9


@pytest.mark.slow
def test_a_tight_step_equals_one_on_the_whole_grid_in_float32(relative_error):
    state, poses = body(3, (0.4, 0.0, 0.6), np.float32)
    whole, tight = (STEP(make(np.float32, **options), state, poses) for options in ({}, TIGHT))
    assert relative_error(tight, whole) < 1e-5


@pytest.mark.parametrize("reach", REACHES)
@pytest.mark.parametrize("corner", [(0.2, 0.1, 0.9), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_active_nodes_are_those_in_reach_and_between_them_along_z(corner, reach):
    """Against the 27 nodes of each particle wherever it may move, node by node."""
    state, _ = body(1, corner, np.float32)
    columns = {}
    for cells in (np.asarray(state.x) - GRID.origin) / GRID.spacing:
        # With half a cell, a list also holds the fourth node above one at the very edge of the grid.
        first = np.maximum(np.floor(cells - 0.5 - reach % 1.0), 0).astype(int) - int(reach)
        for offset in np.ndindex(*[3 + int(2 * reach)] * 3):
            node = first + np.asarray(offset)
            if np.all(node >= 0) and np.all(node < GRID.shape):
                columns.setdefault(tuple(node[:2]), []).append(node[2])
    wanted = [(i, j, k) for i, j in sorted(columns) for k in range(min(columns[i, j]), max(columns[i, j]) + 1)]
    assert int(count_nodes(GRID, state.x, reach=reach)) == len(wanted) < 750
    nodes = list_nodes(GRID, state.x, 750, reach=reach)
    used = slice(len(wanted))
    np.testing.assert_array_equal(np.stack(nodes.index, -1)[used], wanted)
    np.testing.assert_allclose(
        np.stack(nodes.position, -1)[used], GRID.origin + GRID.spacing * np.asarray(wanted), rtol=1e-5
    )
    slots = [int(nodes.offset[i * GRID.shape[1] + j]) + k for i, j, k in wanted]
    np.testing.assert_array_equal(slots, np.arange(len(wanted)))


@pytest.mark.parametrize("num_active", [60, 750])
@pytest.mark.parametrize("reach", REACHES)
@pytest.mark.parametrize("corner", [(0.2, 0.1, 0.9), (1.0, 1.0, 1.0)])
def test_the_program_for_a_gpu_makes_the_same_lists(corner, reach, num_active):
    """Bit for bit, for lists that are too short too, in a batch of environments."""
    x = jnp.stack([body(seed, place, np.float32)[0].x for seed, place in ((1, corner), (2, (0.5, 0.0, 0.3)))])
    columns, lists = active_nodes._COLUMNS, active_nodes._LIST
    on_cpu, on_gpu = (
        jax.jit(lambda x, i=i: (c := columns[i]((GRID, reach), (x,), ()), lists[i]((GRID, num_active), c, ())))(x)
        for i in (0, 1)
    )
    assert int(on_cpu[0][1].sum(1).min()) > 60
    jax.tree.map(np.testing.assert_array_equal, on_gpu, on_cpu)
    one = jax.jit(lambda x: lists.other((GRID, num_active), columns.other((GRID, reach), (x,), ()), ()))(x[1])
    jax.tree.map(np.testing.assert_array_equal, one, tuple(a[1] for a in on_cpu[1]))


def test_all_nodes_are_in_order():
    nodes = all_nodes(GRID, np.float32)
    np.testing.assert_array_equal(np.stack(nodes.index, -1), list(np.ndindex(GRID.shape)))
    np.testing.assert_allclose(nodes.position[1], np.tile(np.repeat(GRID.axis_nodes(1), 15), 17), rtol=1e-6)


def test_too_few_nodes_are_flagged():
    state, poses = body(4, (0.5, 0.5, 0.5), np.float32)
    scene = make(np.float32, max_active_nodes=60)
    end = STEP(scene, state, poses)
    assert int(mpm.check_status(scene, end, start=state)) & Status.INACTIVE_NODES
    assert np.isfinite(end.x).all()


@pytest.mark.parametrize("reach", REACHES)
def test_moving_further_than_the_list_reaches_is_flagged(reach):
    state, _ = body(5, (0.5, 0.5, 0.5), np.float32)
    scene = make(np.float32, reach=reach, **TIGHT)
    near, far = (state.replace(x=state.x.at[3, 1].add(f * reach * GRID.spacing)) for f in (0.99, 1.01))
    assert int(mpm.check_status(scene, near, start=state)) & Status.INACTIVE_NODES == 0
    assert int(mpm.check_status(scene, far, start=state)) & Status.INACTIVE_NODES


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("reach", REACHES)
def test_a_list_holds_all_nodes_of_particles_that_moved_as_far_as_they_may(reach, sign):
    state, _ = body(6, (0.5, 0.5, 0.5), np.float32)
    nodes = list_nodes(GRID, state.x, 750, reach=reach)
    used = int(count_nodes(GRID, state.x, reach=reach))
    listed = {tuple(node) for node in np.stack(nodes.index, -1)[:used]}
    cells = (np.asarray(state.x) + sign * 0.999 * reach * GRID.spacing - GRID.origin) / GRID.spacing
    for lowest in np.floor(cells - 0.5).astype(int):
        assert {tuple(lowest + np.asarray(offset)) for offset in np.ndindex(3, 3, 3)} <= listed


def test_impossible_numbers_are_refused():
    with pytest.raises(ValueError, match="max_active_nodes is 26: give at least the 27 that one particle touches"):
        make(max_active_nodes=26)
    with pytest.raises(ValueError, match=r"^reach is 0\.7: give 0\.5 or 1\.0$"):
        make(reach=0.7)
