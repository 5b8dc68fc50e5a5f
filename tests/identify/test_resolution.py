"""Environments on other grids: the same body, box and time; a record is fitted on two of them and extrapolated."""

import jax
import numpy as np
import pytest

import rewax
from rewax.envs.kit.soft_parts import lattice_box
from rewax.identify.resolution import resampled, with_cells

CENTER, SIZE = np.array([0.5, 0.1, 0.4]), np.array([0.3, 0.12, 0.2])


@pytest.mark.parametrize("count", [200, 2000])
def test_new_particles_fill_the_same_body_evenly(count):
    rest = np.asarray(lattice_box(CENTER, SIZE, (12, 5, 8)))
    points = resampled(rest, float(SIZE.prod()), count)
    assert points.shape == (count, 3)
    np.testing.assert_allclose(points.mean(0), CENTER, atol=0.04 * SIZE.max())
    half = 0.5 * SIZE + 0.2 * 0.025  # what lies nearest has round edges, so its faces lie slightly farther out
    assert (np.abs(points - CENTER) < half).all()
    assert np.ptp(points, axis=0) == pytest.approx(SIZE, abs=1.2 * float(SIZE.prod() / count) ** (1 / 3))
    distance = np.sqrt(((points[:, None] - points[None]) ** 2).sum(-1)) + np.eye(count)
    assert np.median(distance.min(1)) > 0.35 * (SIZE.prod() / count) ** (1 / 3)


@pytest.mark.parametrize("cells", [16, 36])
def test_an_environment_keeps_its_body_its_box_and_its_time(cells):
    env = rewax.make("RollingFlat", scale="small")
    other = with_cells(env, cells)
    old, new, spacing = env.scene.grid, other.scene.grid, 1.0 / cells
    assert new.spacing == pytest.approx(spacing)
    assert all(a <= b + 1e-9 for a, b in zip(new.origin, old.origin, strict=True)) or cells < 24
    floor = (env.scene.walls.lower[1].position - new.origin[1]) / spacing
    assert floor == pytest.approx(round(floor), abs=1e-6) and floor >= 2
    assert (np.array(new.shape) - 1) * spacing + new.origin == pytest.approx(
        (np.array(old.shape) - 1) * old.spacing + old.origin, abs=1.01 * spacing
    )
    assert other.control_dt == pytest.approx(env.control_dt)
    assert other.num_substeps == -(-10 * cells // 24)
    per_cell = [len(e.rest_positions) * float(e.scene.particle_volume) for e in (env, other)]
    assert per_cell[0] == pytest.approx(per_cell[1], rel=1e-5)
    assert len(other.rest_positions) / len(env.rest_positions) == pytest.approx((cells / 24) ** 3, rel=0.02)
    assert all(c.softness is None for c in other.scene.colliders)
    state = jax.jit(other.step)(jax.jit(other.reset)(jax.random.key(0)), np.array([0.0, -1.0, 0.0], np.float32))
    assert int(state.status) == 0


def test_what_has_no_other_grid_is_said():
    env = rewax.make("RollingFlat", scale="small")
    with pytest.raises(ValueError, match="cells is -1: give the number of cells per metre"):
        with_cells(env, -1)
    with pytest.raises(ValueError, match="no particles at rest_positions"):
        with_cells(rewax.make("Hopper", scale="small"), 24)


def test_a_robot_or_a_body_of_fixed_particles_has_no_other_grid():
    with pytest.raises(ValueError, match="GripperLift has a robot with substeps of its own: build its grids by hand"):
        with_cells(rewax.make("GripperLift", scale="small"), 60)
    hand = rewax.make("HandFlip", scale="small")
    with pytest.raises(ValueError, match=r"HandFlip needs its own particles .*: build its grids by hand"):
        with_cells(hand, 0.75 / hand.scene.grid.spacing)
