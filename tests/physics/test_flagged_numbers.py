"""Numbers that cannot be are flagged by ``check_status`` where they were traced or replaced; sizes, refused in time."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.envs.tasks.rolling_flat import small
from rewax.physics import mpm, rigid, tets
from rewax.physics.contact import Collider, Ground, PenaltyContact
from rewax.physics.mpm import Grid, Hencky, Material, Newtonian, Tait, VonMises, Wall, Walls
from rewax.physics.mpm.stepping import free_velocity
from rewax.physics.mpm.transfer import GridFields
from rewax.physics.numerics import Pose
from rewax.physics.rigid import Penalty
from rewax.physics.shapes import Capsule
from rewax.physics.tets import tetmesh
from rewax.status import FATAL, Status
from rewax.struct import replace_leaf

GRID = Grid(shape=(8, 9, 10), spacing=0.1)
NUM = 5
STATE = mpm.initial_state(np.linspace(0.2, 0.5, 3 * NUM).reshape(NUM, 3))
nan = float("nan")


@functools.cache
def scene() -> mpm.MPMScene:
    """Every number is an array, so that all of them are traced."""
    made = mpm.make_scene(
        grid=GRID,
        dt=1e-3,
        material=Material(density=1000.0, elasticity=Hencky(youngs_modulus=np.full(NUM, 1e4), poissons_ratio=0.3), plasticity=VonMises(yield_stress=300.0), viscosity=Newtonian(viscosity=0.1),),
        particle_volume=1e-4,
        colliders=(Collider(shape=Capsule(radius=0.05, half_length=0.1), friction=0.5, softness=666.0),),
        walls=Walls(lower=(None, Wall(position=0.1, friction=0.3), None), upper=(None, None, None)),
    )  # fmt: skip
    return jax.tree.map(jnp.asarray, made)


STATUS = jax.jit(mpm.check_status)
POSES = mpm.static_poses(2, 1)


def with_leaf(tree, path: str, value):
    """The tree with one leaf, named as in ``jax.tree_util.keystr``, replaced by a value of its shape."""
    leaves, treedef = jax.tree_util.tree_flatten_with_path(tree)
    names = [jax.tree_util.keystr(p) for p, _ in leaves]
    assert path in names, names
    changed = [jnp.full_like(a, value) if n == path else a for n, (_, a) in zip(names, leaves, strict=True)]
    return treedef.unflatten(changed)


@pytest.mark.parametrize(
    ("path", "values"),
    [
        (".material.elasticity.youngs_modulus", (nan, 0.0, -1.0, jnp.inf, 1e7)),  # the last needs a smaller dt
        (".material.elasticity.poissons_ratio", (nan, 0.5, -1.0)),
        (".material.density", (nan, 0.0, -1000.0, 1.0)),
        (".material.plasticity.yield_stress", (nan, 0.0)),
        (".material.viscosity.viscosity", (nan, -0.1, 1e5)),
        (".particle_volume", (nan, 0.0, -1e-4)),
        (".gravity", (nan, jnp.inf)),
        (".colliders[0].friction", (nan, -0.1)),
        (".colliders[0].softness", (nan, 0.0)),
        (".colliders[0].shape.radius", (nan, 0.0, -0.1)),
        (".colliders[0].shape.half_length", (nan, -0.1)),
        (".colliders[0].offset", (nan,)),
        (".colliders[0].rotation", (nan,)),
        (".walls.lower[1].friction", (nan, -0.1)),
    ],
)
def test_numbers_that_cannot_be_are_flagged_in_compiled_programs_and_outside(path, values):
    assert STATUS(scene(), STATE, poses=POSES) == Status.OK
    for value in values:
        broken = with_leaf(scene(), path, value)
        assert STATUS(broken, STATE, poses=POSES) == Status.INVALID_PARAMETERS, value
    assert mpm.check_status(broken, STATE, poses=POSES) == Status.INVALID_PARAMETERS


def test_every_leaf_of_a_scene_is_looked_at():
    for path, _ in jax.tree_util.tree_flatten_with_path(scene())[0]:
        broken = with_leaf(scene(), jax.tree_util.keystr(path), nan)
        assert STATUS(broken, STATE, poses=POSES) & Status.INVALID_PARAMETERS, path


def test_one_bad_particle_is_enough():
    stiff = scene().material.elasticity.youngs_modulus.at[3].set(-1.0)
    assert STATUS(replace_leaf(scene(), "material.elasticity.youngs_modulus", stiff), STATE, poses=POSES) == 64


def test_poses_that_are_not_finite_are_flagged():
    """A collider at NaN touches nothing, so that no particle tells of it."""
    for broken in (
        Pose(POSES.position.at[1, 0, 2].set(nan), POSES.rotation),
        Pose(POSES.position, POSES.rotation.at[2, 0, 1, 1].set(jnp.inf)),
    ):
        end = jax.jit(mpm.step)(scene(), STATE, broken)
        assert np.isfinite(end.x).all()
        assert STATUS(scene(), end, poses=broken) == Status.INVALID_PARAMETERS


def test_scenes_made_of_traced_stiffness_are_checked_for_a_stable_dt():
    """``make_scene`` knows no traced stiffness: ``vmap`` over it flags those that dt is too long for."""
    limit = 1e-3

    def status(factor):
        stable = Material(density=1000.0, elasticity=Hencky(youngs_modulus=1.0, poissons_ratio=0.3))
        modulus = (mpm.largest_stable_dt(stable, GRID) / limit) ** 2  # dt is at its limit
        made = mpm.make_scene(
            grid=GRID,
            dt=limit,
            material=replace_leaf(stable, "elasticity.youngs_modulus", factor * modulus),
            particle_volume=1e-4,
        )
        return mpm.check_status(made, STATE)

    found = jax.jit(jax.vmap(status))(jnp.array([0.5, 0.999, 1.01, 2.0, nan]))
    np.testing.assert_array_equal(found, [0, 0, 64, 64, 64])


def test_a_flagged_number_ends_the_episode():
    env = small()
    state = env.reset(jax.random.key(0))
    step = jax.jit(lambda env, state: env.step(state, jnp.zeros(3)))
    assert step(env, state).status == Status.OK
    end = step(with_leaf(env, ".scene.colliders[0].friction", -0.9), state)
    assert end.terminated and end.status == Status.INVALID_PARAMETERS and Status.INVALID_PARAMETERS in FATAL
    twice = with_leaf(env, ".joint_step", nan)
    assert int(step(twice, state).status) & Status.INVALID_PARAMETERS


# --- Tetrahedra and rigid bodies --------------------------------------------------------------------------------------


def test_tet_scenes_flag_every_leaf():
    mesh = tetmesh.box((0.2, 0.2, 0.2), (1, 1, 1))
    made = tets.make_scene(
        mesh=mesh, density=1000.0, mu=4e4, lam=6e4, dt=1e-4, damping=0.1, held=[0],
        contact=PenaltyContact(stiffness=1e3, damping=1.0, friction_damping=1.0, friction=0.5), ground=Ground(normal=np.eye(3)[1]),
        colliders=(Collider(shape=Capsule(radius=0.05, half_length=0.1), friction=0.5),),
    )  # fmt: skip
    made = jax.tree.map(jnp.asarray, made)
    status, state = jax.jit(tets.check_status), tets.initial_state(mesh.vertices)
    assert status(made, state, poses=POSES) == Status.OK
    for path, _ in jax.tree_util.tree_flatten_with_path(made)[0]:
        if jax.tree_util.keystr(path) != ".mobility":
            broken = with_leaf(made, jax.tree_util.keystr(path), nan)
            assert status(broken, state, poses=POSES) & Status.INVALID_PARAMETERS, path
    for path, value in {
        ".mu": 6e5, ".lam": 6e8, ".damping": -1.0, ".mass": 0.0, ".rest_volume": -1.0, ".contact.friction": -0.1,
        ".contact.stiffness": 1e9, ".colliders[0].friction": -0.1, ".colliders[0].shape.radius": 0.0,
    }.items():  # fmt: skip
        assert status(with_leaf(made, path, value), state, poses=POSES) == Status.INVALID_PARAMETERS, path
    assert tets.check_status(made.replace(lam=-1.0), state) == Status.INVALID_PARAMETERS
    moved = Pose(POSES.position * nan, POSES.rotation)
    assert status(made, state, poses=moved) == Status.INVALID_PARAMETERS


def test_rigid_models_flag_every_leaf():
    text = """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 1"><joint type="hinge"/>
      <geom size="0.1" mass="1"/></body></worldbody></mujoco>"""
    model = rigid.load(text, dt=1e-3, penalty=Penalty(stiffness=1e3))
    status, state = jax.jit(rigid.check_status), rigid.initial_state(model)
    assert status(state, model) == Status.OK
    for path, leaf in jax.tree_util.tree_flatten_with_path(model)[0]:
        if leaf.size:
            assert status(state, with_leaf(model, jax.tree_util.keystr(path), nan)) == Status.INVALID_PARAMETERS, path
    for path in (".gravity", ".parameters['geom_friction']", ".parameters['body_mass']", ".penalty.stiffness"):
        want = Status.OK if path == ".gravity" else Status.INVALID_PARAMETERS
        assert status(state, with_leaf(model, path, -1.0)) == want, path
    assert status(state.replace(qpos=state.qpos * nan), model) == Status.NAN


# --- Scales, and sizes that do not fit --------------------------------------------------------------------------------


def falling(spacing: float):
    """A random cloud of water that falls for 20 substeps; how long, and its scene and state."""
    time = (spacing / 9.81) ** 0.5
    dt = 0.01 * time
    x = spacing * (3.0 + 2.0 * np.random.default_rng(0).random((40, 3)))
    water = mpm.make_scene(
        grid=Grid(shape=(9, 9, 9), spacing=spacing), dt=dt, particle_volume=jnp.asarray(8 * spacing**3 / 40),
        material=Material(density=1000.0, elasticity=Tait(speed_of_sound=0.1 * spacing / dt)),
    )  # fmt: skip
    return 20 * dt, water, mpm.initial_state(jnp.asarray(x, jnp.float32), water)


@pytest.mark.parametrize("spacing", [1e-2, 1e-5, 1e-6])
def test_everything_falls_alike_whatever_the_size_of_cells(spacing):
    time, water, state = falling(spacing)
    end = jax.jit(mpm.step)(water, state, mpm.static_poses(20))
    np.testing.assert_allclose(end.v[:, 1] / (-9.81 * time), 1.0, rtol=1e-3)
    assert mpm.check_status(water, end) == Status.OK


def test_node_velocities_have_gradients_at_small_cells():
    """d (p / m) / dm = -p / m^2, whose parts 1 / m^2 and p / m^2 are beyond float32 in kilograms."""
    _, water, _ = falling(1e-6)
    mass = jnp.asarray([1e-16, 1e-20, 1e-23])
    speed = jnp.asarray([1e-6, -1e-9, 0.0])

    def velocity(mass, momentum):
        return jnp.stack(free_velocity(water.replace(gravity=jnp.zeros(3)), GridFields(mass, (momentum,) * 3))[1])

    np.testing.assert_allclose(velocity(mass, mass * speed)[0], speed, rtol=1e-6)
    by_mass, by_momentum = jax.jacrev(velocity, argnums=(0, 1))(mass, mass * speed)
    np.testing.assert_allclose(jnp.diagonal(by_mass[0]), -speed / mass, rtol=1e-5)
    np.testing.assert_allclose(jnp.diagonal(by_momentum[0]), 1.0 / mass, rtol=1e-5)


def lowered(some: mpm.MPMScene, num_envs: int, num: int) -> str:
    """The program that steps several environments of that many particles, not compiled."""
    x = jax.ShapeDtypeStruct((num_envs, num, 3), jnp.float32)
    return jax.jit(jax.vmap(lambda x: mpm.step(some, mpm.initial_state(x), POSES).x)).lower(x).as_text()


def uniform() -> mpm.MPMScene:
    """A scene for any number of particles."""
    return replace_leaf(scene(), "material.elasticity.youngs_modulus", 1e4)


def test_more_nodes_than_int32_counts_are_refused_when_traced():
    big = uniform().replace(grid=Grid(shape=(64, 64, 64), spacing=0.1))
    sentence = (
        "2048 environments of 262144 nodes are stepped at once, but int32 indices hold "
        "2047 environments of that size: step fewer at once, with jax.lax.map over groups of them, or give"
    )
    assert lowered(big, 2047, 1)
    with pytest.raises(ValueError, match="^" + re.escape(sentence)):
        lowered(big, 2048, 1)


@pytest.mark.parametrize("max_active_nodes", [None, 400])
def test_no_constant_of_a_program_is_as_long_as_all_particles(max_active_nodes):
    text = lowered(uniform().replace(max_active_nodes=max_active_nodes), 8, 50)
    shapes = re.findall(r'constant dense<["\[].*> : tensor<([0-9x]+)x', text)
    sizes = [int(np.prod([int(n) for n in shape.split("x")])) for shape in shapes]
    assert sizes and max(sizes) < 50, sizes


def test_the_nodes_that_sufficed_cannot_be_forgotten():
    tight = scene().replace(max_active_nodes=30)
    with pytest.raises(ValueError, match=r"^start is None with a scene of max_active_nodes 30: give the particles at"):
        mpm.check_status(tight, STATE)
    assert mpm.check_status(tight, STATE, start=STATE) & Status.INACTIVE_NODES
