"""rewax in the audit."""

from collections.abc import Callable
from importlib.metadata import version

import audit_scenes as s
import jax
import jax.numpy as jnp
import numpy as np
from audit_protocol import NotSupported, Problem

from rewax.physics import coupling, mpm, rigid
from rewax.physics.contact import Collider
from rewax.physics.coupling import free_body
from rewax.physics.mpm import Grid, Hencky, Material, NeoHookean, VonMises, Wall, WallKind, Walls
from rewax.physics.numerics import Pose
from rewax.physics.rigid import Penalty
from rewax.physics.shapes import Box, Sphere

VERSION = version("rewax")
VARIANTS = {
    "rewax": "reverse mode; penalty contacts of rigid bodies",
    "rewax (MuJoCo's law)": "reverse mode; rigid bodies under MuJoCo's soft constraints, soft onset of 2 cm",
}
PLATE_HALF_HEIGHT = 0.1
SOFT_ONSET = {"solref": (0.02, 1.0), "solimp": (1e-4, 0.95, 0.02, 0.5, 2.0)}
MUJOCO_DT = 2e-3


def build(variant: str, scene: str, size: float = 1.0) -> Problem:
    """A scene; ``size`` shortens it, for tests."""
    jax.config.update("jax_enable_x64", True)
    if variant == "rewax":
        outcome = {"slide-rigid": slide_rigid, "foot": foot}.get(scene, lambda n: soft(scene, n))(size)
    elif scene in ("slide-rigid", "foot"):
        outcome = {"slide-rigid": slide_rigid, "foot": foot}[scene](size, penalty=False)
    else:
        raise NotSupported("a variant for rigid bodies only")
    value, gradient = jax.jit(outcome), jax.jit(jax.grad(outcome))
    return Problem(
        value=lambda p: float(value(jnp.asarray(p))),
        gradient=lambda p: np.asarray(gradient(jnp.asarray(p))),
        precision="float64",
        how=VARIANTS[variant],
    )


def make_scene(scene: str, colliders: tuple[Collider, ...] = ()) -> mpm.MPMScene:
    law = {"youngs_modulus": s.YOUNGS_MODULUS, "poissons_ratio": s.POISSONS_RATIO}
    elastic = Material(density=s.DENSITY, elasticity=NeoHookean(**law))
    dough = Material(density=s.DENSITY, elasticity=Hencky(**law), plasticity=VonMises(yield_stress=s.YIELD_STRESS))
    floor = Wall(position=s.FLOOR, friction=s.FLOOR_FRICTION)
    if scene in ("press", "drop"):
        floor = Wall(position=s.FLOOR, kind=WallKind.STICKY)
    return mpm.make_scene(
        grid=Grid(shape=s.GRID, spacing=s.SPACING),
        dt=s.SOFT_DT,
        material=dough if scene == "press" else elastic,
        particle_volume=(s.SPACING / 2) ** 3,
        gravity=(0.0, -s.GRAVITY, 0.0),
        colliders=colliders,
        walls=Walls(lower=(None, floor, None), upper=(None, None, None)),
    )


def soft(scene: str, size: float) -> Callable[[jax.Array], jax.Array]:
    start = mpm.initial_state(jnp.asarray(s.particles(scene)))
    num_substeps = max(1, round(size * s.substeps(scene, s.SOFT_DT)))
    poses = mpm.static_poses(num_substeps)

    def throw(p: jax.Array) -> jax.Array:
        moving = start.replace(v=start.v + jnp.stack([p[0], p[1], 0.0 * p[0]]))
        end = mpm.step(made, moving, poses)
        return end.x[:, 0].mean() + end.x[:, 1].mean()

    def slide(p: jax.Array) -> jax.Array:
        floor = made.walls.lower[1].replace(friction=p[1])
        rough = made.replace(walls=Walls(lower=(None, floor, None), upper=(None, None, None)))
        moving = start.replace(v=start.v + p[0] * jnp.array([1.0, 0.0, 0.0]))
        return mpm.step(rough, moving, poses).x[:, 0].mean()

    def press(p: jax.Array) -> jax.Array:
        times = s.SOFT_DT * jnp.arange(num_substeps + 1)
        first = jnp.array([0.4, s.top(scene) + s.PLATE_GAP + PLATE_HALF_HEIGHT, s.MIDDLE])
        position = first + times[:, None] * jnp.stack([p[0], p[1], 0.0 * p[0]])
        path = Pose(position[:, None], jnp.broadcast_to(jnp.eye(3), (num_substeps + 1, 1, 3, 3)))
        return jnp.sum((mpm.step(made, start, path).x - start.x) ** 2, axis=1).mean()

    def drop(p: jax.Array) -> jax.Array:
        moment = 0.4 * p[1] * s.BALL_RADIUS**2 * jnp.eye(3)
        inertia = free_body.Inertia(mass=p[1:], moment=moment[None])
        at = jnp.array([[0.4, s.top(scene) + s.BALL_GAP + s.BALL_RADIUS, s.MIDDLE]])
        ball = free_body.bodies_at_rest(at)
        ball = ball.replace(velocity=ball.velocity.at[0, 1].add(p[0]))
        return coupling.step(made, inertia, start, ball, poses)[1].position[0, 1]

    plate = Box(half_size=jnp.array([1.0, PLATE_HALF_HEIGHT, 1.0]))
    colliders = {
        "press": (Collider(shape=plate, friction=s.PLATE_FRICTION),),
        "drop": (Collider(shape=Sphere(radius=s.BALL_RADIUS), friction=0.0),),
    }
    made = make_scene(scene, colliders.get(scene, ()))
    return {"throw": throw, "slide": slide, "press": press, "drop": drop}[scene]


def load(mjcf: Callable[[float], str], penalty: bool) -> rigid.RigidModel:
    if penalty:
        law = Penalty(stiffness=s.CONTACT_STIFFNESS, depth_damping=s.DEPTH_DAMPING, friction_damping=s.FRICTION_DAMPING)
        return rigid.load(mjcf(s.RIGID_DT), dt=s.RIGID_DT, penalty=law)
    model = rigid.load(mjcf(MUJOCO_DT), dt=MUJOCO_DT)
    return model.with_parameters(
        pair_solref=jnp.array([SOFT_ONSET["solref"]]), pair_solimp=jnp.array([SOFT_ONSET["solimp"]])
    )


def slide_rigid(size: float, penalty: bool = True) -> Callable[[jax.Array], jax.Array]:
    model = load(s.box_mjcf, penalty)
    num_substeps = max(1, round(size * s.substeps("slide-rigid", model.dt)))

    def outcome(p: jax.Array) -> jax.Array:
        friction = model.parameters["pair_friction"].at[:, :2].set(p[1])
        state = rigid.initial_state(model, qvel=jnp.stack([p[0], 0.0 * p[0]]))
        return rigid.step(model.with_parameters(pair_friction=friction), state, num_substeps=num_substeps).qpos[0]

    return outcome


def foot(size: float, penalty: bool = True) -> Callable[[jax.Array], jax.Array]:
    model = load(s.leg_mjcf, penalty)
    num_substeps = max(1, round(size * s.substeps("foot", model.dt)))

    def outcome(p: jax.Array) -> jax.Array:
        state = rigid.initial_state(model, qpos=jnp.array([0.0, s.LEG_START[1]]), qvel=jnp.stack([p[0], 0.0 * p[0]]))
        end = rigid.step(model, state, p[1:], num_substeps=num_substeps)
        return s.LEG_START[0] + end.qpos[0] + 0.2 * end.qpos[1]

    return outcome
