"""The simulation as a whole: conservation, analytic solutions, and how it composes with jit, vmap and NaN."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material
from mpm_bodies import DT, GRID, NUM, NUM_SUBSTEPS, STEP, cube, relative, run, spinning

from rewax.physics import mpm
from rewax.physics.contact.colliders import Collider
from rewax.physics.mpm import VonMises, invariants
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.walls import Wall, WallKind, Walls
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Sphere
from rewax.physics.shapes.sampling import fill_box
from rewax.status import Status
from rewax.struct import replace_leaf

# --- Conservation -----------------------------------------------------------------------------------------------------


def test_a_free_body_keeps_momentum_and_angular_momentum_and_gains_no_energy():
    """1000 substeps in float32 of a spinning, moving, vibrating cube."""
    scene, state = cube()
    state = spinning(state, noise=0.3)
    state = state.replace(v=state.v + jnp.array([0.3, 0.2, -0.4]))
    end = run(scene, state)
    assert end.x.dtype == jnp.float32
    assert float(jnp.max(jnp.abs(end.F - jnp.eye(3)))) > 0.01
    assert relative(invariants.momentum(scene, end), invariants.momentum(scene, state)) < 1e-5
    assert relative(invariants.angular_momentum(scene, end), invariants.angular_momentum(scene, state)) < 2e-5
    before, after = (float(invariants.total_energy(scene, s)) for s in (state, end))
    assert 0.3 * before < after < before


def test_free_fall_is_symplectic_euler():
    """v_n = n g dt and x_n = x_0 + g dt^2 n (n + 1) / 2 for every particle, nothing deformed."""
    g = np.array([1.0, -9.81, 2.0])
    scene, state = cube(gravity=tuple(g))
    end = run(scene, state)
    n = NUM_SUBSTEPS
    np.testing.assert_allclose(end.v, np.broadcast_to(n * DT * g, (NUM, 3)), atol=5e-5)
    np.testing.assert_allclose(end.x - state.x, np.broadcast_to(g * DT**2 * n * (n + 1) / 2, (NUM, 3)), atol=5e-6)
    np.testing.assert_allclose(end.F, state.F, atol=5e-6)  # rounding turns particles a little


def test_dough_that_does_not_yield_is_an_elastic_body():
    """1000 substeps of a vibrating cube in float32. A return map that rounds turns 4e-5 of the volume into noise."""
    ends = []
    for plasticity in (None, VonMises):
        scene, state = cube(plasticity=plasticity)
        scene = scene if plasticity is None else replace_leaf(scene, "material.plasticity.yield_stress", 1e6)
        ends.append(run(scene, spinning(state, noise=0.3)))
    elastic, dough = (np.linalg.det(np.asarray(end.F, np.float64)) for end in ends)
    assert np.abs(elastic - 1.0).max() > 1e-4
    np.testing.assert_allclose(dough, elastic, rtol=0, atol=1e-5)


def test_repeats_are_bit_identical():
    scene, state = cube()
    state = spinning(state, noise=0.3)
    jax.tree.map(np.testing.assert_array_equal, run(scene, state), run(scene, state))


# --- Storing ----------------------------------------------------------------------------------------------------------


def test_store_every_must_divide():
    scene, state = cube()
    with pytest.raises(ValueError, match="store_every is 3: give an integer that divides the 4 substeps"):
        mpm.step(scene, state, mpm.static_poses(4), store_every=3)


# --- Analytic solutions -----------------------------------------------------------------------------------------------


def column(cells: int):
    """A slender column on a floor, confined laterally so that it can only move up and down: constrained compression."""
    height, density, E, nu, g = 1.0, 1000.0, 1e6, 0.3, 1.0
    spacing = height / cells
    constrained = E * (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    c = np.sqrt(constrained / density)
    x = fill_box((0.0, height / 2, 0.0), (spacing, height, spacing), spacing / 2)
    grid = Grid(shape=(6, cells + 6, 6), spacing=spacing, origin=(-2.5 * spacing, -2 * spacing, -2.5 * spacing))
    # Slip walls from both sides meet in the column's axis: every node keeps to vertical motion.
    side, floor = Wall(position=0.0, kind=WallKind.SLIP), Wall(position=0.5 * spacing, kind=WallKind.STICKY)
    scene = mpm.make_scene(
        grid=grid, dt=0.2 * spacing / c, particle_volume=spacing**2 * height / len(x), gravity=(0.0, -g, 0.0),
        material=flat_material(youngs_modulus=E, poissons_ratio=nu, density=density),
        walls=Walls(lower=(side, floor, side), upper=(side, None, side)),
    )  # fmt: skip
    return scene, mpm.initial_state(x), density * g * height**2 / (2 * constrained), 4 * height / c


def sag_and_period(cells: int) -> tuple[float, float, float, float]:
    """Mean sag of the top over one oscillation and the oscillation's period; and what theory says."""
    scene, state, sag, period = column(cells)
    every = 5
    top = np.asarray(state.x[:, 1]) > 1.0 - scene.grid.spacing / 2
    rest, heights = state.x, [0.0]
    poses = mpm.static_poses(every)
    for _ in range(int(1.3 * period / (scene.dt * every))):
        state = STEP(scene, state, poses)
        heights.append(float(jnp.mean((state.x - rest)[top, 1])))
    u, t = np.array(heights), np.arange(len(heights)) * scene.dt * every
    # Released at rest, the top returns there after one period: the peak of the parabola through the highest samples.
    late = t > 0.7 * period
    peak = t[late][np.argmax(u[late])]
    near = np.abs(t - peak) < 0.12 * period
    a, b, _ = np.polyfit(t[near] - peak, u[near], 2)
    measured = peak - b / (2 * a)
    whole = t <= measured
    return -float(np.trapezoid(u[whole], t[whole]) / t[whole][-1]), float(measured), sag, period


def test_a_column_sags_and_swings_as_theory_says(x64):
    """Sag rho g H^2 / (2 M) and first axial period 4 H / c within 3 %, closer when the grid is refined."""
    errors = []
    for cells in (8, 20):
        sag, period, want_sag, want_period = sag_and_period(cells)
        errors.append((abs(sag / want_sag - 1), abs(period / want_period - 1)))
    print("column: relative errors of sag and period", errors)
    assert max(errors[1]) < 0.03, errors
    assert errors[1][0] < errors[0][0] and errors[1][1] < errors[0][1], errors


# --- Status -----------------------------------------------------------------------------------------------------------


def test_status_bits():
    scene, state = cube()

    def status(**changes) -> int:
        return int(mpm.check_status(scene, state.replace(**changes)))

    assert status() == Status.OK
    for name in ("x", "v", "C", "F"):
        broken = getattr(state, name).at[(3, *[0] * (getattr(state, name).ndim - 1))].set(jnp.nan)
        assert status(**{name: broken}) & Status.NAN, name
    assert status(x=state.x.at[5, 1].set(GRID.lower[1])) == Status.OUT_OF_DOMAIN
    assert status(x=state.x.at[5, 2].set(GRID.upper[2])) == Status.OUT_OF_DOMAIN
    assert status(v=state.v.at[7, 0].set(-1.01 * GRID.spacing / DT)) == Status.CFL
    assert status(v=state.v.at[7, 0].set(-0.99 * GRID.spacing / DT)) == Status.OK


def test_a_collider_without_pose_is_refused():
    scene, state = cube()
    scene = scene.replace(colliders=(Collider(shape=Sphere(radius=0.04), friction=0.5),))
    with pytest.raises(ValueError, match="collider 0 belongs to body 0, but there are poses of 0 bodies"):
        mpm.step(scene, state, mpm.static_poses(2))


def pressed_by(softness):
    """A cube under a ball that comes down and rolls, and how its particles end: (poses, x) -> x."""
    scene, state = cube()
    ball = Collider(shape=Sphere(radius=0.06), friction=0.5, softness=softness)
    scene = scene.replace(colliders=(ball,))
    start = np.asarray(state.x).mean(0) + [0.003, 0.06 + 0.5 * np.ptp(np.asarray(state.x)[:, 1]), 0.002]
    steps = np.arange(5)[:, None] * DT * np.array([0.3, -0.4, 0.1])
    position = jnp.asarray((start + steps)[:, None])

    def end(position, x):
        poses = Pose(position, jnp.broadcast_to(jnp.eye(3), (5, 1, 3, 3)))
        return mpm.step(scene, state.replace(x=x), poses).x

    return jax.jit(end), (position, jnp.asarray(state.x, float))


def test_without_a_softness_colliders_reach_one_cell(x64):
    """Also through ``replace``, which checks nothing; bit for bit what the number itself gives."""
    own, args = pressed_by(None)
    given, _ = pressed_by(np.log(10.0) / GRID.spacing)
    np.testing.assert_array_equal(own(*args), given(*args))
    assert np.abs(own(*args) - args[1]).max() > 1e-6
    free = cube()[0].replace(colliders=(Collider(shape=Sphere(radius=0.06), friction=0.5),))
    assert not [path for path, _ in jax.tree.leaves_with_path(free) if "softness" in jax.tree_util.keystr(path)]


@pytest.mark.slow
def test_derivatives_through_colliders_without_a_softness(x64):
    """Reverse, forward and central difference, by the ball's path and the particles' positions."""
    end, args = pressed_by(None)
    rng = np.random.default_rng(0)
    weights = jnp.asarray(rng.standard_normal(args[1].shape))
    aside, faster = rng.standard_normal((2, 3))  # a path that jitters would meet the onset of contact at other nodes
    path = jnp.asarray(aside + np.linspace(0.0, 0.1, len(args[0]))[:, None, None] * faster)
    moves = (1e-3 * path, 1e-3 * jnp.asarray(rng.standard_normal(args[1].shape)))

    def outcome(position, x):
        return jnp.sum(weights * end(position, x))

    gradient = jax.grad(outcome, argnums=(0, 1))(*args)
    reverse = sum(jnp.sum(g * m) for g, m in zip(gradient, moves, strict=True))
    forward = jax.jvp(outcome, args, moves)[1]
    h = 1e-4
    ahead, behind = (outcome(*(a + s * h * m for a, m in zip(args, moves, strict=True))) for s in (1, -1))
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)
    np.testing.assert_allclose(reverse, (ahead - behind) / (2 * h), rtol=1e-6)
    assert float(jnp.abs(gradient[0]).max()) > 0.0


def test_flattened_and_inverted_particles_are_flagged():
    scene, state = cube()
    for value in (0.0, -0.3):
        broken = state.replace(F=state.F.at[3, 1, 1].set(value))
        assert int(mpm.check_status(scene, broken)) == Status.INVERTED


def test_particles_that_leave_are_held_at_the_border_and_flagged():
    scene, state = cube(gravity=(0.0, -200.0, 0.0))
    end = run(scene, state)
    assert int(mpm.check_status(scene, end)) & Status.OUT_OF_DOMAIN
    assert float(jnp.min(end.x[:, 1])) == pytest.approx(GRID.lower[1], abs=1e-6)
    assert np.isfinite(end.x).all()


def test_float32_stays_float32_and_nothing_is_promoted_in_silence():
    walls = Walls(lower=(None, Wall(position=0.0, friction=0.3), None), upper=(None, None, None))
    scene, state = cube(plasticity=VonMises, walls=walls)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        out = jax.eval_shape(mpm.step, scene, state, mpm.static_poses(2, dtype=jnp.float32))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(out))
