"""A block of particles on a floor, squeezed by a shape that turns: everything of a substep at work."""

import jax
import jax.numpy as jnp
import numpy as np
from flat_materials import flat_material

from rewax.physics import mpm
from rewax.physics import shapes as sdf
from rewax.physics.contact.colliders import Collider
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.walls import Wall, Walls
from rewax.physics.numerics.pose import Pose

NUM, DT = 27, 1e-3
GRID = Grid(shape=(9, 8, 9), spacing=0.05)
MIDDLE = np.array([0.2, 0.15, 0.2])
FLOOR = 0.1
SHAPES = {
    "capsule": sdf.Capsule(radius=0.06, half_length=0.05),
    "box": sdf.Box(half_size=np.array([0.06, 0.05, 0.07])),
    "cylinder": sdf.Cylinder(radius=0.07, half_length=0.05),
}


def squeezed(elasticity, plasticity, shape: str, wall: Wall, num_substeps: int = 1):
    """A block on a floor under a shape that comes down and turns; a little deformed, moving at random.

    Half of the particles start beyond yield. All leaves are arrays, so that every one can be differentiated.
    """
    rng = np.random.default_rng(4)
    x = MIDDLE + rng.uniform(-0.05, 0.05, (NUM, 3))
    logs = np.where(np.arange(NUM)[:, None] % 2, 0.15, 0.004) * rng.standard_normal((NUM, 3))
    q = np.linalg.qr(rng.standard_normal((NUM, 3, 3)))[0]
    state = mpm.MPMState(
        x=x,
        v=0.5 * rng.standard_normal((NUM, 3)) - [0.0, 0.5, 0.0],
        C=3.0 * rng.standard_normal((NUM, 3, 3)),
        F=np.einsum("nij,nj,nkj->nik", q, np.exp(logs), q) + 0.002 * rng.standard_normal((NUM, 3, 3)),
    )
    tilt, _ = np.linalg.qr(np.eye(3) + 0.3 * rng.standard_normal((3, 3)))
    collider = Collider(
        shape=SHAPES[shape], offset=np.array([0.0, 0.01, 0.0]), rotation=tilt, friction=0.4, softness=30.0
    )
    scene = mpm.MPMScene(
        grid=GRID,
        dt=DT,
        material=flat_material(
            youngs_modulus=1e4, poissons_ratio=0.3, density=1000.0, yield_stress=300.0,
            elasticity=elasticity, plasticity=plasticity,
        ),
        particle_volume=np.full(NUM, 1e-3 / NUM),
        gravity=np.array([0.5, -9.81, 0.3]),
        colliders=(collider,),
        walls=Walls(lower=(None, wall, None), upper=(None, None, None)),
    )  # fmt: skip
    t = DT * np.arange(num_substeps + 1)[:, None]
    turn = np.stack([np.eye(3) + np.sin(3 * a) * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 0]]) for a in t[:, 0]])
    # Off the nodes: a shape's normal jumps at its middle, and no derivative sees that.
    poses = Pose((MIDDLE + [0.011, 0.093, 0.007] + t * [0.2, -0.6, 0.1])[:, None], turn[:, None])
    return jax.tree.map(lambda a: jnp.asarray(a, float), (scene, state, poses))


def one_substep(args):
    scene, state, poses = args
    before, after = (jax.tree.map(lambda p, t=t: p[t], poses) for t in (0, 1))
    return mpm.substep(scene, state, before, after)
