"""The simulation as a whole: conservation, analytic solutions, stability, and how it composes with jit, vmap and NaN."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics import mpm
from rewax.physics.contact.colliders import Collider
from rewax.physics.mpm import invariants
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.laws import FLUIDS, MAX_HARDENING
from rewax.physics.mpm.materials import Elasticity, Material, Plasticity, sound_speed
from rewax.physics.mpm.scene import STABLE_DIFFUSION_NUMBER
from rewax.physics.mpm.walls import Wall, WallKind, Walls
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes.primitives import Sphere
from rewax.physics.shapes.sampling import fill_box, sample_box
from rewax.status import Status

DT, NUM_SUBSTEPS, NUM = 1e-4, 1000, 64
GRID = Grid(shape=(12, 14, 12), spacing=0.05, origin=(-0.3, -0.35, -0.3))
SIDE = 0.1
STEP = jax.jit(mpm.step, static_argnames="store_every")
"""Compiled once for each grid, law, number of particles and of substeps: tests share these."""


def modulus_at(courant_number: float, density: float = 1000.0, nu: float = 0.3) -> float:
    """Young's modulus with which DT is this multiple of the time that sound takes through a cell."""
    unit = float(sound_speed(Material(youngs_modulus=1.0, poissons_ratio=nu, density=density)))
    return (courant_number * GRID.spacing / (DT * unit)) ** 2


def cube(
    courant_number=0.05,
    gravity=(0.0, 0.0, 0.0),
    seed=0,
    elasticity=Elasticity.HENCKY,
    plasticity=Plasticity.NONE,
    **changes,
):
    """A cube of random particles in the middle of the grid, away from its border, and its scene."""
    material = Material(
        youngs_modulus=modulus_at(courant_number), poissons_ratio=0.3, density=1000.0, yield_stress=1e3,
        elasticity=elasticity, plasticity=plasticity,
    )  # fmt: skip
    material = jax.tree.map(lambda a: jnp.asarray(a, float), material)
    scene = mpm.MPMScene(
        grid=GRID,
        dt=DT,
        material=material,
        particle_volume=jnp.asarray(SIDE**3 / NUM),
        gravity=jnp.asarray(gravity),
        **changes,
    )
    state = mpm.initial_state(sample_box(jax.random.key(seed), (0.0, 0.0, 0.0), (SIDE,) * 3, NUM))
    return scene, state


def run(scene, state, num_substeps=NUM_SUBSTEPS):
    return STEP(scene, state, mpm.static_poses(num_substeps))


def spinning(state, omega=(1.0, -2.0, 3.0), noise=0.0, seed=1):
    w = np.asarray(omega)
    spin = jnp.asarray([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]], state.x.dtype)
    v = state.x @ spin.T + noise * jax.random.normal(jax.random.key(seed), state.x.shape)
    return state.replace(v=v, C=jnp.broadcast_to(spin, state.C.shape))


def relative(a, b) -> float:
    return float(np.linalg.norm(np.asarray(a, np.float64) - np.asarray(b, np.float64)) / np.linalg.norm(np.asarray(b)))


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


def test_repeats_are_bit_identical():
    scene, state = cube()
    state = spinning(state, noise=0.3)
    jax.tree.map(np.testing.assert_array_equal, run(scene, state), run(scene, state))


# --- Stability --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("elasticity", [e for e in Elasticity if e not in FLUIDS])
def test_stable_at_the_limit_and_not_far_above_it(elasticity):
    """A perturbed cube at the largest stable dt calms down; at 1.4 times the sound's time through a cell it explodes."""
    growth = []
    for courant_number in (mpm.STABLE_COURANT_NUMBER, 1.4):
        scene, state = cube(courant_number, elasticity=elasticity)
        speed = 1e-3 * float(sound_speed(scene.material))
        state = state.replace(v=speed * jax.random.normal(jax.random.key(3), state.x.shape))
        end = run(scene, state)
        growth.append(float(jnp.sqrt(jnp.mean(end.v**2) / jnp.mean(state.v**2))))
    assert growth[0] < 0.6
    assert not growth[1] < 10.0


def test_viscosity_is_stable_at_its_limit_and_not_far_above_it():
    """The same for a viscous fluid at the largest dt that sound allows; at three times what viscosity allows it explodes."""
    growth = []
    speed = mpm.STABLE_COURANT_NUMBER * GRID.spacing / DT
    for number in (STABLE_DIFFUSION_NUMBER, 3 * STABLE_DIFFUSION_NUMBER):
        scene, state = cube()
        viscosity = number * 1000.0 * GRID.spacing**2 / DT
        material = Material(density=1000.0, speed_of_sound=speed, viscosity=viscosity, elasticity=Elasticity.TAIT)
        limit = float(mpm.largest_stable_dt(material, GRID))
        assert limit == pytest.approx(DT * STABLE_DIFFUSION_NUMBER / number, rel=1e-5)
        scene = scene.replace(material=jax.tree.map(lambda a: jnp.asarray(a, float), material))
        state = state.replace(v=1e-3 * speed * jax.random.normal(jax.random.key(3), state.x.shape))
        growth.append(float(jnp.sqrt(jnp.mean(run(scene, state).v ** 2) / jnp.mean(state.v**2))))
    assert growth[0] < 0.6
    assert not growth[1] < 10.0


def test_largest_stable_dt_is_the_number_used():
    material = Material(youngs_modulus=modulus_at(mpm.STABLE_COURANT_NUMBER), poissons_ratio=0.3, density=1000.0)
    assert float(mpm.largest_stable_dt(material, GRID)) == pytest.approx(DT, rel=1e-5)
    c = float(sound_speed(material))
    assert float(mpm.largest_stable_dt(material, GRID, max_speed=c)) == pytest.approx(DT / 2, rel=1e-5)
    snow = material.replace(plasticity=Plasticity.SNOW)
    assert float(mpm.largest_stable_dt(snow, GRID)) == pytest.approx(DT / MAX_HARDENING**0.5, rel=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dt": 1.01e-4}, "dt is 0.000101 s, above the largest stable 0.0001 s .* smaller dt"),
        ({"dt": 0.0}, "dt is 0.0, but must be positive"),
        ({"youngs_modulus": -1.0}, "youngs_modulus is -1.0, but must be positive: give"),
        ({"youngs_modulus": float("nan")}, "youngs_modulus is nan, but must be positive"),
        ({"density": 0.0}, "density is 0.0, but must be positive"),
        ({"poissons_ratio": 0.5}, "poissons_ratio is 0.5: give a value above -1 and below 0.5"),
        ({"poissons_ratio": -1.0}, "poissons_ratio is -1.0: give"),
        ({"yield_stress": 0.0, "plasticity": Plasticity.VON_MISES}, "yield_stress is 0.0, but must be positive"),
        ({"particle_volume": -1e-6}, "particle_volume is -1e-06, but must be positive"),
    ],
)
def test_impossible_scenes_are_refused_with_the_remedy(changes, message):
    material = dict(youngs_modulus=modulus_at(mpm.STABLE_COURANT_NUMBER), poissons_ratio=0.3, density=1000.0)
    scene = dict(grid=GRID, dt=0.999e-4, particle_volume=1e-6)
    mpm.make_scene(material=Material(**material), **scene)
    for name, value in changes.items():
        (scene if name in scene else material)[name] = value
    with pytest.raises(ValueError, match=message):
        mpm.make_scene(material=Material(**material), **scene)


def test_particles_must_begin_inside_the_box_and_outside_the_colliders():
    scene, state = cube()
    for broken in (state.x.at[7, 1].set(2.0), state.x.at[7, 1].set(jnp.nan)):
        with pytest.raises(
            ValueError, match=r"1 particles lie outside the box from \(-0.275, .* number 7, at .*: move them"
        ):
            mpm.initial_state(broken, scene)
    collider = Collider(shape=Sphere(radius=0.04), offset=jnp.zeros(3), rotation=jnp.eye(3), friction=0.5)
    scene = scene.replace(colliders=(collider,))
    mpm.check_placement(scene, state, Pose(jnp.array([[0.1, 0.0, 0.0]]), jnp.eye(3)[None]))
    with pytest.raises(ValueError, match=r"particles lie up to 0.0298 m inside collider 0 \(Sphere\): move it"):
        mpm.check_placement(scene, state)
    mpm.check_placement(scene, state, tolerance=0.04)


def test_store_every_must_divide():
    scene, state = cube()
    with pytest.raises(ValueError, match="store_every is 3 with 4 substeps"):
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
        material=Material(youngs_modulus=E, poissons_ratio=nu, density=density),
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
    scene, state = cube(plasticity=Plasticity.VON_MISES, walls=walls)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        out = jax.eval_shape(mpm.step, scene, state, mpm.static_poses(2, dtype=jnp.float32))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(out))
