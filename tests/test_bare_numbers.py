"""Numbers that are given bare are parameters: ``jax.grad`` finds each, and it has an effect."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewax
from rewax.envs.kit import ThinTask
from rewax.envs.leaves import EnvLeaves
from rewax.physics import mpm, tets
from rewax.physics.contact import Collider, Ground, PenaltyContact
from rewax.physics.mpm import Grid, Material, Wall, Walls, laws, materials
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.pose import Pose
from rewax.physics.rigid import Penalty
from rewax.physics.shapes import Plane, Sphere
from rewax.physics.tets import tetmesh

LAWS = {
    laws.Hencky: {"youngs_modulus": 2000, "poissons_ratio": 0.3},
    laws.FixedCorotated: {"youngs_modulus": 2000, "poissons_ratio": 0.3},
    laws.NeoHookean: {"youngs_modulus": 2000, "poissons_ratio": 0.3},
    laws.QuadraticFluid: {"youngs_modulus": 2000, "poissons_ratio": 0.3},
    laws.Tait: {"speed_of_sound": 3},
    laws.VonMises: {"yield_stress": 20},
    laws.DruckerPrager: {"friction_angle": 0.1, "cohesion": 0.001},
    laws.Snow: {"critical_compression": 0.025, "critical_stretch": 0.0075, "hardening": 10},
    laws.Newtonian: {"viscosity": 1},
    laws.Muscle: {"fibre": (0, 1, 0), "activation": 5},
}
"""Bare numbers of every law."""
FIELDS = {laws.Plasticity: "plasticity", laws.Viscosity: "viscosity", laws.ActiveStress: "muscle"}
DEFORMED = [np.diag([1.2, 0.9, 0.95]) + 0.1 * np.eye(3, k=1), np.diag([0.8, 0.9, 0.85]) + 0.3 * np.eye(3, k=1)]


def paths(tree) -> dict[str, np.ndarray]:
    return {jax.tree_util.keystr(path)[1:]: np.asarray(a) for path, a in jax.tree.leaves_with_path(tree)}


def numeric_fields(kind) -> set[str]:
    return {f.name for f in dataclasses.fields(kind) if "number" in f.metadata}


def test_the_table_has_every_law_and_every_number():
    every = {kind for kind in vars(laws).values() if isinstance(kind, type) and dataclasses.is_dataclass(kind)}
    assert set(LAWS) == every - {laws.TwoModuli, laws.Principal}
    for kind, numbers in LAWS.items():
        assert set(numbers) == numeric_fields(kind), kind


@pytest.mark.parametrize("kind", LAWS, ids=lambda kind: kind.__name__)
def test_stress_depends_on_every_number_of_a_law(kind):
    field = next((name for base, name in FIELDS.items() if issubclass(kind, base)), "elasticity")
    parts = {"elasticity": laws.Hencky(**LAWS[laws.Hencky]), field: kind(**LAWS[kind])}
    F = cp.split_matrix(jnp.asarray(np.stack(DEFORMED)))
    C = cp.split_matrix(jnp.asarray(np.stack([np.eye(3, k=1)] * 2)))

    def stress(material):
        memory = tuple(jnp.full(2, a - 0.01) for a in material.initial_memory)
        response = materials.respond(material, F, velocity_gradient=C, memory=memory)
        return jnp.sum(cp.join_matrix(response.stress) ** 2)

    slopes = paths(jax.grad(stress)(Material(density=1000, **parts)))
    for name in numeric_fields(kind):
        slope = slopes[f"{field}.{name}"]
        assert np.isfinite(slope).all() and np.any(slope != 0.0), name
    assert kind is not laws.Tait or slopes["density"] != 0.0


def test_a_step_depends_on_every_number_of_a_scene_with_colliders_and_walls():
    """A block falls onto a wall and is brushed by a ball; walls and colliders are given bare numbers."""
    law = laws.Hencky(**LAWS[laws.Hencky])
    scene = mpm.make_scene(
        grid=Grid(shape=(8, 8, 8), spacing=0.1),
        dt=1e-3,
        material=Material(density=1000, elasticity=law),
        particle_volume=1.25e-4,
        gravity=(1, -10, 2),
        colliders=(Collider(shape=Sphere(radius=0.1), offset=(0.4, 0.5, 0.4), friction=0.3, softness=20),),
        walls=Walls(lower=(None, Wall(position=0.25, friction=0.2), None), upper=(None, None, None)),
    )
    x = jnp.asarray(np.random.default_rng(0).uniform(0.3, 0.5, (64, 3)))
    state = mpm.initial_state(x, scene)
    state = state.replace(v=jnp.broadcast_to(jnp.array([1.0, -1.0, 0.5]), x.shape))
    moving = jnp.linspace(0.0, 1.0, 6)[:, None, None] * jnp.array([0.01, -0.002, 0.0])
    poses = Pose(moving, jnp.broadcast_to(jnp.eye(3), (6, 1, 3, 3)))
    slopes = paths(jax.jit(jax.grad(lambda scene: jnp.sum(mpm.step(scene, state, poses).v ** 2)))(scene))
    assert {
        "particle_volume", "gravity", "material.density", "material.elasticity.youngs_modulus",
        "material.elasticity.poissons_ratio", "colliders[0].shape.radius", "colliders[0].offset",
        "colliders[0].rotation", "colliders[0].friction", "colliders[0].softness", "walls.lower[1].friction",
    } == set(slopes)  # fmt: skip
    unmoved = {"particle_volume"}  # masses and stresses grow with it alike
    for name, slope in slopes.items():
        assert np.isfinite(slope).all() and (np.any(slope != 0.0) or name in unmoved), name


def test_a_step_of_tetrahedra_depends_on_every_number():
    contact = PenaltyContact(
        stiffness=1000, damping=1, friction_damping=200, friction=0.5, radius=0.01, onset=0.05, depth_damping=3
    )
    mu, lam = (float(a) for a in tets.stable_parameters(10000, 0.3))
    scene = tets.make_scene(
        mesh=tetmesh.box((0.2, 0.2, 0.2), (1, 1, 1)), density=1000, mu=mu, lam=lam, dt=1e-4, damping=1, activation=0.1,
        contact=contact, ground=Ground(normal=(0, 1, 0), height=0.001),
        colliders=(Collider(shape=Plane(), offset=(0, 0.002, 0), friction=0.4),),
    )  # fmt: skip
    state = tets.initial_state(jnp.asarray(scene_positions(scene)))
    slow = np.where(np.arange(len(state.x)) % 2, 1.0, 1e-3)[:, None]  # some stick, some slide
    state = state.replace(v=jnp.asarray(slow * np.random.default_rng(0).normal(size=state.x.shape)))
    poses = mpm.static_poses(3, num_bodies=1)
    slopes = paths(jax.grad(lambda scene: jnp.sum(tets.step(scene, state, poses).v ** 2))(scene))
    for name in ("mu", "lam", "damping", "activation", "gravity", "colliders[0].friction", "ground.height"):
        assert np.any(slopes[name] != 0.0), name
    for name in numeric_fields(PenaltyContact):
        assert np.any(slopes[f"contact.{name}"] != 0.0), name


def scene_positions(scene) -> np.ndarray:
    mesh = tetmesh.box((0.2, 0.2, 0.2), (1, 1, 1))
    assert scene.topology.num_vertices == len(mesh.vertices)
    return mesh.vertices * [1.0, 1.1, 1.0] + [0.0, 0.1, 0.0]


def test_penalty_of_rigid_bodies_is_made_of_parameters():
    numbers = dict.fromkeys(numeric_fields(Penalty), 1)
    slopes = paths(jax.grad(lambda p: sum(jnp.sum(a**2) for a in jax.tree.leaves(p)))(Penalty(**numbers)))
    assert slopes == dict.fromkeys(numbers, 2.0)


@pytest.mark.parametrize("name", rewax.list_envs())
def test_every_number_of_a_task_is_a_parameter(name):
    env = rewax.make(name, scale="small")
    form = EnvLeaves.of(env).form
    bare = [leaf for leaf, number in zip(form.names, form.numbers, strict=True) if number is not None]
    assert not bare
    static = [
        f.name for f in dataclasses.fields(env)
        if not f.metadata.get("pytree_node", True) and isinstance(getattr(env, f.name), float)
    ]  # fmt: skip
    drawn = {"thickness"} if isinstance(env, ThinTask) else set()  # of cloth in pictures alone
    assert set(static) <= {"dt", "control_dt", "observation_scale", *drawn}, "floats of a task are parameters"
