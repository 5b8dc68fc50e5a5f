"""The sides of the box: what each kind does, where they stand, and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as hs

from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.walls import Wall, WallKind, Walls, apply_walls, check_walls

OPEN = (None, None, None)


def after_walls(walls, velocity, num=6, spacing=0.1):
    """All nodes start with the same velocity."""
    grid = Grid(shape=(num, num, num), spacing=spacing)
    v = tuple(jnp.full(grid.num_nodes, a) for a in velocity)
    return np.stack(apply_walls(walls, grid, indices(grid), v), axis=-1).reshape(*grid.shape, 3)


def indices(grid):
    """Index of every node along x, y, z."""
    return tuple(jnp.asarray(a.reshape(-1), jnp.int32) for a in np.indices(grid.shape))


@pytest.mark.parametrize(
    ("kind", "friction", "into", "away"),
    [
        (WallKind.STICKY, 0.0, [0, 0, 0], [0, 0, 0]),
        (WallKind.SLIP, 0.0, [3, 0, 4], [3, 0, 4]),
        (WallKind.SEPARATING, 0.0, [3, 0, 4], [3, 2, 4]),
        (WallKind.SEPARATING, 0.5, [3 * 0.8, 0, 4 * 0.8], [3, 2, 4]),
        (WallKind.SEPARATING, 5.0, [0, 0, 0], [3, 2, 4]),
        (WallKind.GRIPPING, 0.0, [0, 0, 0], [3, 2, 4]),
    ],
)
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_each_kind_of_wall(x64, kind, friction, into, away, side):
    wall = (None, Wall(position=0.25, kind=kind, friction=friction), None)
    walls = Walls(**({"lower": OPEN, "upper": OPEN} | {side: wall}))
    sign = 1.0 if side == "lower" else -1.0
    behind = np.arange(6) * 0.1 < 0.25 if side == "lower" else np.arange(6) * 0.1 > 0.25
    for v, expected in (([3.0, -2.0 * sign, 4.0], into), ([3.0, 2.0 * sign, 4.0], away)):
        got = after_walls(walls, v)
        expected = np.array(expected) * [1, sign, 1]
        np.testing.assert_allclose(got[:, behind], np.broadcast_to(expected, got[:, behind].shape), atol=1e-14)
        np.testing.assert_array_equal(got[:, ~behind], np.broadcast_to(v, got[:, ~behind].shape))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_walls_stand_where_their_metres_say_at_every_resolution(axis):
    """Changing the grid moves no wall: nodes strictly below 0.2 m are held, also where 0.2 m is a node."""
    lower = tuple(Wall(position=0.2, kind=WallKind.STICKY) if a == axis else None for a in range(3))
    for num, spacing in ((6, 0.1), (11, 0.05), (8, 0.07), (21, 0.025)):
        held = np.all(after_walls(Walls(lower=lower, upper=OPEN), (1.0, 1.0, 1.0), num, spacing) == 0, axis=-1)
        expected = np.arange(num) * spacing < 0.2 - 1e-9
        np.testing.assert_array_equal(np.moveaxis(held, axis, 0), np.broadcast_to(expected[:, None, None], held.shape))


def test_friction_of_a_wall_is_differentiable(x64):
    def speed(friction):
        wall = (None, Wall(position=0.25, friction=friction), None)
        return jnp.sum(apply_walls(Walls(lower=wall, upper=OPEN), grid, indices(grid), velocity)[0])

    grid = Grid(shape=(4, 4, 4), spacing=0.1)
    velocity = tuple(jnp.full(64, a) for a in (3.0, -2.0, 4.0))
    # 16 nodes in each of the 3 layers behind: u_x = 3 (1 - 2 mu / 5).
    np.testing.assert_allclose(jax.grad(speed)(0.5), 48 * 3 * -2 / 5, rtol=1e-12)


def numpy_walls(walls, grid, velocity):
    """The conditions node by node: x, y, z, at each axis the lower wall first; shapes (*grid.shape, 3)."""
    v = np.array(velocity, float)
    for index in np.ndindex(grid.shape):
        for axis in range(3):
            for wall, inward in ((walls.lower[axis], 1.0), (walls.upper[axis], -1.0)):
                node = grid.origin[axis] + grid.spacing * index[axis]
                if wall is None or inward * (node - wall.position) >= -1e-6 * grid.spacing:
                    continue
                normal, across = inward * v[index][axis], [a for a in range(3) if a != axis]
                if wall.kind is WallKind.STICKY or (wall.kind is WallKind.GRIPPING and normal < 0):
                    v[index] = 0.0
                elif wall.kind is WallKind.SLIP:
                    v[index][axis] = 0.0
                elif wall.kind is WallKind.SEPARATING and normal < 0:
                    speed = np.linalg.norm(v[index][across])
                    v[index][across] *= max(0.0, 1.0 + wall.friction * normal / speed) if speed > 0 else 1.0
                    v[index][axis] = 0.0
    return v


GRID = Grid(shape=(7, 8, 9), spacing=0.1, origin=(-0.3, 0.2, 1.0))


@given(
    seed=hs.integers(0, 10_000),
    kinds=hs.lists(hs.one_of(hs.none(), hs.sampled_from(WallKind)), min_size=6, max_size=6),
    cells=hs.lists(hs.floats(0.0, 3.0), min_size=6, max_size=6),
    friction=hs.sampled_from([0.0, 0.3, 2.0]),
)
def test_six_walls_of_any_kind_and_place_are_those_of_a_loop_over_nodes(x64, seed, kinds, cells, friction):
    """Walls stand on nodes and between them, up to three cells inside the box; in edges and corners several act."""
    sides = []
    for side, (kind, cell) in enumerate(zip(kinds, cells, strict=True)):
        axis, is_upper = side % 3, side >= 3
        end = GRID.origin[axis] + GRID.spacing * ((GRID.shape[axis] - 1 - cell) if is_upper else cell)
        sides.append(None if kind is None else Wall(position=end, kind=kind, friction=friction))
    walls = Walls(lower=tuple(sides[:3]), upper=tuple(sides[3:]))
    velocity = np.random.default_rng(seed).standard_normal((*GRID.shape, 3))
    velocity[0, 0, 0] = 0.0
    components = tuple(jnp.asarray(velocity[..., a].reshape(-1)) for a in range(3))
    got = np.stack(apply_walls(walls, GRID, indices(GRID), components), axis=-1).reshape(velocity.shape)
    np.testing.assert_allclose(got, numpy_walls(walls, GRID, velocity), atol=1e-13)


@pytest.mark.parametrize("cells", [1.0, 1.0 + 1e-7, 1.0 - 1e-7, 1.01, 0.99, 1.5])
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_a_wall_on_a_node_leaves_it_free_and_one_beside_it_does_not(cells, side):
    """Nodes strictly beyond the wall obey it. Within 1e-6 of a cell the wall counts as on the node."""
    lower = side == "lower"
    position = 0.1 * cells if lower else 0.1 * (5 - cells)
    wall = (Wall(position=position, kind=WallKind.STICKY), None, None)
    held = np.all(after_walls(Walls(**({"lower": OPEN, "upper": OPEN} | {side: wall})), (1.0, 1.0, 1.0)) == 0, axis=-1)
    expected = np.arange(6) < (2 if cells > 1.001 else 1)
    np.testing.assert_array_equal(held[:, 0, 0], expected if lower else expected[::-1])


KINDS = [(kind, 0.0) for kind in WallKind] + [(WallKind.SEPARATING, 0.4), (WallKind.SEPARATING, 5.0)]


@pytest.mark.parametrize(("kind", "friction"), KINDS)
def test_derivatives_by_velocity_and_friction(x64, kind, friction, random_like, central_difference, inner):
    """Reverse = forward = finite difference, of nodes that move into the wall, away, and stand."""
    grid = Grid(shape=(4, 4, 4), spacing=0.1)
    velocity = tuple(jnp.asarray(a) for a in np.random.default_rng(0).standard_normal((3, 64)))
    args = (velocity, jnp.float64(friction))

    def after(args):
        velocity, mu = args
        wall = (None, Wall(position=0.15, kind=kind, friction=mu), None)
        return apply_walls(Walls(lower=wall, upper=OPEN), grid, indices(grid), velocity)

    move, cotangent = random_like(1, args), random_like(2, velocity)
    value, tangent = jax.jvp(after, (args,), (move,))
    assert np.any(np.stack(value) != np.stack(velocity))
    for got, expected in zip(tangent, central_difference(after, args, move), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-8)
    (gradient,) = jax.vjp(after, args)[1](cotangent)
    assert inner(gradient, move) == pytest.approx(inner(cotangent, tangent), rel=1e-11)
    assert (float(gradient[1]) != 0.0) == (kind is WallKind.SEPARATING)
    still = tuple(jnp.zeros(64) for _ in range(3))
    at_rest = jax.vjp(after, (still, jnp.float64(friction)))[1](cotangent)[0]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(at_rest))


@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("speed", [-1.0, 1.0])
def test_derivatives_of_nodes_that_move_straight_into_the_wall(x64, friction, speed, central_difference):
    """Their tangential velocity is exactly zero, and Coulomb's friction holds a small one."""
    grid = Grid(shape=(4, 4, 4), spacing=0.1)
    walls = Walls(lower=(None, Wall(position=0.15, friction=friction), None), upper=OPEN)
    velocity = (jnp.zeros(64), jnp.full(64, speed), jnp.zeros(64))
    move = (jnp.ones(64), jnp.zeros(64), jnp.linspace(0.0, 2.0, 64))

    def after(velocity):
        return apply_walls(walls, grid, indices(grid), velocity)

    tangent = jax.jvp(after, (velocity,), (move,))[1]
    for got, expected in zip(tangent, central_difference(after, velocity, move), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-8)
    gradient = jax.vjp(after, velocity)[1](move)[0]
    for got, expected in zip(gradient[::2], tangent[::2], strict=True):  # the map is symmetric here
        np.testing.assert_allclose(got, expected, atol=1e-12)


@pytest.mark.parametrize("kind", WallKind)
@pytest.mark.parametrize(("low", "high", "is_legal"), [(0.3, 0.1, False), (0.25, 0.25, False), (0.2, 0.2, True)])
def test_crossed_walls_that_hold_every_node_are_refused_unless_they_slip(kind, low, high, is_legal):
    """Two slip walls hold one axis of all nodes, which is plane strain. On a node, both leave it free."""
    side = [(None, None, Wall(position=position, kind=kind)) for position in (low, high)]
    walls, grid = Walls(lower=side[0], upper=side[1]), Grid(shape=(6, 6, 6), spacing=0.1)
    if is_legal or kind is WallKind.SLIP:
        check_walls(walls, grid)
        return
    sentence = (
        rf"^walls\.lower\[2\]\.position is {low} m and walls\.upper\[2\]\.position {high} m, which together act on"
    )
    with pytest.raises(ValueError, match=sentence):
        check_walls(walls, grid)
