"""How deep particles lie inside colliders, and the bit that tells."""

import jax.numpy as jnp
import numpy as np
import pytest
from mpm_bodies import STEP, cube

from rewax.physics import mpm
from rewax.physics.contact.colliders import Collider
from rewax.physics.contact.penetration import penetration
from rewax.physics.mpm.walls import Wall, Walls
from rewax.physics.numerics.components import split_vector
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Box, Sphere
from rewax.status import Status

TURNED = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])


def test_depth_is_that_of_the_deepest_point_in_any_collider():
    colliders = (
        Collider(shape=Sphere(radius=0.3), offset=jnp.array([2.0, 0.0, 0.0]), friction=0.0, body=1),
        Collider(shape=Sphere(radius=0.1), friction=0.0, body=0),
        Collider(shape=Box(half_size=jnp.array([0.5, 0.1, 0.1])), friction=0.0, body=1),
    )
    middle = np.array([0.0, 0.0, 5.0])
    bodies = Pose(jnp.array([np.zeros(3), middle]), jnp.array([np.eye(3), TURNED]))

    def depth(*points):
        return float(penetration(colliders, bodies, split_vector(jnp.array(points))))

    in_sphere = middle + TURNED @ [2.0, 0.0, 0.2]
    in_box = middle + TURNED @ [0.45, 0.0, 0.0]
    assert depth(in_sphere) == pytest.approx(0.1, rel=1e-4)
    assert depth(in_box) == pytest.approx(0.05, rel=1e-4)
    assert depth(in_box, in_sphere, [9.0, 9.0, 9.0]) == pytest.approx(0.1, rel=1e-4)
    assert depth([0.0, 0.0, 1.0]) == pytest.approx(-0.9, rel=1e-4)
    assert float(penetration((), bodies, split_vector(jnp.zeros((1, 3))))) == -np.inf


@pytest.mark.parametrize(("depth_in_cells", "deep"), [(-1.0, False), (1.4, False), (1.6, True)])
def test_status_tells_that_a_particle_is_deep_inside_a_tool(depth_in_cells, deep):
    scene, state = cube(colliders=(Collider(shape=Sphere(radius=0.2), friction=0.0),))
    lowest = state.x[jnp.argmin(state.x[:, 1])]  # the top of the sphere is this far above it
    center = lowest + jnp.array([0.0, depth_in_cells * scene.grid.spacing - 0.2, 0.0])
    poses = Pose(jnp.broadcast_to(center, (2, 1, 3)), jnp.broadcast_to(jnp.eye(3), (2, 1, 3, 3)))
    status = int(mpm.check_status(scene, state, start=state, poses=poses))
    assert bool(status & Status.PENETRATION) == deep


@pytest.mark.parametrize(("gap", "jammed"), [(0.05, False), (-0.15, True)])
def test_status_tells_that_a_press_left_no_room_for_a_block(gap, jammed):
    """A plate comes down on a block on the floor, and stops a cell above the floor or three cells below it."""
    plate = Collider(shape=Box(half_size=jnp.array([0.2, 0.2, 0.2])), friction=0.5)
    floor = Walls(lower=(None, Wall(position=-0.05), None), upper=(None, None, None))
    scene, state = cube(colliders=(plate,), walls=floor)
    heights = jnp.linspace(0.27, gap + 0.15, 201)  # of the plate's middle: its lower face is 0.2 below
    positions = jnp.stack([jnp.zeros(201), heights, jnp.zeros(201)], axis=1)[:, None]
    poses = Pose(positions, jnp.broadcast_to(jnp.eye(3), (201, 1, 3, 3)))
    end = STEP(scene, state, poses)
    assert bool(jnp.all(jnp.isfinite(end.x)))
    assert bool(int(mpm.check_status(scene, end, start=state, poses=poses)) & Status.PENETRATION) == jammed
