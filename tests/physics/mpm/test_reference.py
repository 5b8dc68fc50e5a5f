"""A whole substep against MLS-MPM written down plainly: dense weights, LAPACK's SVD, vectors of three, autodiff.

The plain substep below follows the papers line by line and shares no code with the one under test but the containers.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material
from hypothesis import given, settings
from hypothesis import strategies as st

from rewax.physics import mpm
from rewax.physics.contact.colliders import Collider
from rewax.physics.mpm import FixedCorotated, Hencky, NeoHookean, VonMises
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.walls import Wall, WallKind, Walls
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Sphere

GRID = Grid(shape=(10, 9, 8), spacing=0.1, origin=(0.0, -0.1, 0.2))
NUM, FLOOR = 10, 0.12
TOLERANCE = {np.float32: 1e-5, np.float64: 1e-12}


def nodes(dtype):
    return jnp.asarray(np.stack(np.meshgrid(*(GRID.axis_nodes(a) for a in range(3)), indexing="ij"), -1), dtype)


def weights(x):
    """Quadratic B-spline weight of every node for every particle, shape (particles, *grid.shape)."""
    u = jnp.abs(nodes(x.dtype)[None] - x[:, None, None, None]) / GRID.spacing
    w = jnp.where(u < 0.5, 0.75 - u**2, jnp.where(u < 1.5, 0.5 * (1.5 - u) ** 2, 0.0))
    return w.prod(-1)


def respond(material, F):
    """Elastic deformation gradient after flow and Kirchhoff stress, one particle, by singular values."""
    E, nu = material.elasticity.youngs_modulus, material.elasticity.poissons_ratio
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    U, s, Vt = jnp.linalg.svd(F, full_matrices=False)
    if material.plasticity is not None:
        e = jnp.log(s)
        deviator = e - e.mean()
        length, limit = jnp.linalg.norm(deviator), material.plasticity.yield_stress / (2 * mu)
        s = jnp.where(length > limit, jnp.exp(e.mean() + deviator * limit / length), s)
    J = s.prod()
    tau = {
        Hencky: 2 * mu * jnp.log(s) + lam * jnp.log(J),
        FixedCorotated: 2 * mu * (s - 1) * s + lam * (J - 1) * J,
        NeoHookean: mu * (s**2 - 1) + lam * jnp.log(J),
    }[type(material.elasticity)]
    return U @ jnp.diag(s) @ Vt, U @ jnp.diag(tau) @ U.T


def plain_substep(scene, state, before, after):
    dt, dx, material = scene.dt, GRID.spacing, scene.material
    F, tau = jax.vmap(respond, (None, 0))(material, state.F)
    mass = scene.particle_volume * material.density
    affine = -dt * scene.particle_volume * 4 / dx**2 * tau + mass * state.C
    w, d = weights(state.x), nodes(state.x.dtype)[None] - state.x[:, None, None, None]
    node_mass = w.sum(0) * mass
    sent = mass * state.v[:, None, None, None] + jnp.einsum("pij,pxyzj->pxyzi", affine, d)
    momentum = jnp.einsum("pxyz,pxyzi->xyzi", w, sent)
    full = node_mass > 1e-15
    v = jnp.where(full[..., None], momentum / jnp.where(full, node_mass, 1.0)[..., None], 0.0) + dt * scene.gravity
    v = collide(scene.colliders[0], before, after, dt, nodes(v.dtype), v)
    behind = nodes(v.dtype)[..., 1] < FLOOR
    v = jnp.where((behind & (v[..., 1] < 0))[..., None], 0.0, v)  # a gripping floor
    v = jnp.where(full[..., None], v, 0.0)
    new_v = jnp.einsum("pxyz,xyzi->pi", w, v)
    C = 4 / dx**2 * jnp.einsum("pxyz,xyzi,pxyzj->pij", w, v, d)
    x = jnp.clip(state.x + dt * new_v, *(jnp.asarray(a, state.x.dtype) for a in (GRID.lower, GRID.upper)))
    return mpm.MPMState(x=x, v=new_v, C=C, F=F + dt * C @ F)


def collide(collider, before, after, dt, x, v):
    """A sphere that moves: PlasticineLab's soft contact."""
    p, R = before.position[0] + before.rotation[0] @ collider.offset, before.rotation[0]
    from_centre = x - p
    distance = jnp.linalg.norm(from_centre, axis=-1) - collider.shape.radius
    normal = from_centre / jnp.linalg.norm(from_centre, axis=-1, keepdims=True)
    material_point = (x - before.position[0]) @ R
    turn = after.rotation[0] - before.rotation[0]
    body = (after.position[0] - before.position[0] + material_point @ turn.T) / dt
    influence = jnp.minimum(jnp.exp(-collider.softness * distance), 1.0)[..., None]
    u = v - body
    approach = jnp.minimum((u * normal).sum(-1, keepdims=True), 0.0)
    tangential = u - approach * normal
    length = jnp.linalg.norm(tangential, axis=-1, keepdims=True)
    slipping = jnp.where(approach < 0, jnp.maximum(length + collider.friction * approach, 0.0) / length, 1.0)
    return jnp.where(influence > 0.1, body + (1 - influence) * u + influence * tangential * slipping, v)


def scene_of(elasticity, plasticity, **options):
    return mpm.make_scene(
        grid=GRID, dt=1e-3, particle_volume=2e-4, gravity=(0.5, -9.0, 0.2),
        material=flat_material(
            youngs_modulus=1e4, poissons_ratio=0.3, density=1000.0,
            yield_stress=800.0,
            elasticity=elasticity, plasticity=plasticity,
        ),
        colliders=(
            Collider(shape=Sphere(radius=0.1), offset=np.array([0.02, 0.0, 0.01]), rotation=np.eye(3), friction=0.4,
                     softness=20.0),
        ),
        walls=Walls(lower=(None, Wall(position=FLOOR, kind=WallKind.GRIPPING), None), upper=(None,) * 3),
        **options,
    )  # fmt: skip


def draw(seed, dtype, scene):
    """Particles around the floor with stretches well apart (the SVD's derivative needs that), and a moving sphere."""
    rng = np.random.default_rng(seed)
    rotations = np.linalg.qr(rng.normal(size=(2, NUM, 3, 3)))[0]
    rotations *= np.linalg.det(rotations)[..., None, None]
    stretches = np.array([0.85, 1.0, 1.2]) * rng.uniform(0.97, 1.03, (NUM, 3))
    state = mpm.MPMState(
        x=rng.uniform([0.2, 0.05, 0.35], [0.6, 0.45, 0.7], (NUM, 3)),
        v=rng.normal(size=(NUM, 3)),
        C=rng.normal(size=(NUM, 3, 3)),
        F=np.einsum("pij,pj,pkj->pik", rotations[0], stretches, rotations[1]),
    )
    angle = 0.02
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    centre = np.array([0.4, 0.3, 0.5]) + 0.05 * rng.normal(size=3)
    before, after = Pose(centre[None], np.eye(3)[None]), Pose((centre + 1e-3)[None], turn[None])
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), (scene, state, before, after))


def value_and_gradient(function, args, cotangent):
    value, back = jax.vjp(function, *args)
    return value, back(cotangent)


RUN = jax.jit(value_and_gradient, static_argnums=0)


@pytest.mark.parametrize(
    ("elasticity", "plasticity", "options", "dtype"),
    [
        (Hencky, VonMises, {"max_active_nodes": 600}, np.float64),
        pytest.param(Hencky, VonMises, {"max_active_nodes": 600}, np.float32, marks=pytest.mark.slow),
        pytest.param(FixedCorotated, None, {}, np.float64, marks=pytest.mark.slow),
        pytest.param(NeoHookean, VonMises, {}, np.float64, marks=pytest.mark.slow),
    ],
)
@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_a_substep_equals_the_plain_one(x64, random_like, elasticity, plasticity, options, dtype, seed):
    """Values, and gradients by particles, material, gravity, collider and poses, each leaf for itself.

    Where float32 is too coarse for the tolerance, it is for the plain substep too, whose rounding errors are allowed
    on top (measured against float64; most of the fast one's are a fifth of them).
    """
    args = draw(seed, np.float64, scene_of(elasticity, plasticity, **options))
    cotangent = random_like(seed, args[1])
    inputs = jax.tree.map(lambda a: a.astype(dtype), (args, cotangent))
    exact = RUN(plain_substep, args, cotangent)
    mine, plain = (RUN(f, *inputs) for f in (mpm.substep, plain_substep))  # (values, gradients)
    assert {a.dtype for a in jax.tree.leaves(mine)} == {np.dtype(dtype)}
    for group, trees in enumerate(zip(mine, plain, exact, strict=True)):
        leaves = [jax.tree.leaves(per_relative_change(t, args) if group else t) for t in trees]
        # Some gradients are zero but for rounding; in float32 the difference of two poses over dt has few digits.
        least = (1e-2 if dtype is np.float64 else 1.0) * max(np.linalg.norm(a) for a in leaves[2])
        for (path, _), m, p, e in zip(jax.tree_util.tree_leaves_with_path(trees[2]), *leaves, strict=True):
            scale = max(np.linalg.norm(e), least)
            error, rounding = np.linalg.norm(m - e) / scale, np.linalg.norm(p - e) / scale
            assert error < TOLERANCE[dtype] + rounding, (group, jax.tree_util.keystr(path), error, rounding)


def per_relative_change(gradient, args):
    """What the outcome changes by with the relative change of each leaf; a rotation, here the identity, only turns."""

    def one(path, g, a):
        g, a = np.asarray(g, np.float64), np.asarray(a)
        if path[-1].name != "rotation":
            return g * np.where(np.isfinite(a), a, 1.0)  # an infinite yield stress has the gradient 0
        return g - np.swapaxes(g, -1, -2) if np.all(a == np.eye(3)) else g

    return jax.tree_util.tree_map_with_path(one, gradient, args)
