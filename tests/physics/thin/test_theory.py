"""Cloth and ropes against theory: catenary, cantilevers, buckling, waves, pendulum, orders of convergence."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from thin_bodies import NOTHING, cloth_scene, equilibrium, free, hessian, rope_scene, run

from rewax.physics import thin

GRAVITY = (0.0, -9.81, 0.0)


def catenary(points, span, length):
    """Sag below the ends at points across the span, of an inextensible chain."""
    low, high = 1e-3, 1e3
    for _ in range(200):  # 2 a sinh(span / 2 a) = length, falling in a
        a = np.sqrt(low * high)
        low, high = (a, high) if 2 * a * np.sinh(min(span / (2 * a), 700.0)) > length else (low, a)
    return a * (np.cosh(span / (2 * a)) - np.cosh((points - span / 2) / a))


def slack(points, sag):
    points = np.array(points)
    points[:, 1] -= sag * np.sin(np.pi * points[:, 0] / points[:, 0].max())
    return points


def test_a_hanging_rope_is_a_catenary(x64):
    length, span = 1.0, 0.8
    mesh = thin.rope(np.linspace([0.0, 0.0, 0.0], [length, 0.0, 0.0], 41))
    scene = rope_scene(mesh, stretch=1e4, bending=0.0, dt=1e-5, gravity=GRAVITY, held=[0, 40])
    x = equilibrium(scene, slack(mesh.vertices * [span, 1, 1], 0.25))
    sag = catenary(x[:, 0], span, length)
    print(f"catenary: error over sag {np.abs(-x[:, 1] - sag).max() / sag.max():.2e}")
    np.testing.assert_allclose(-x[:, 1], sag, atol=5e-3 * sag.max())


def test_a_sheet_between_two_bars_is_a_catenary(x64):
    length, span = 1.0, 0.8
    mesh = thin.sheet(length, 0.1, 20, 1)
    cloth = thin.Cloth(warp=1e4, weft=1e4, shear=5e3, bending=1e-4, density=0.5)
    scene = thin.make_scene(mesh=mesh, dt=1e-5, cloth=cloth, gravity=GRAVITY, held=[0, 1, 40, 41])
    x = equilibrium(scene, slack(mesh.vertices * [span, 1, 1], 0.25))
    sag = catenary(x[:, 0], span, length)
    print(f"catenary: error over sag {np.abs(-x[:, 1] - sag).max() / sag.max():.2e}")
    np.testing.assert_allclose(-x[:, 1], sag, atol=5e-3 * sag.max())


def test_cantilevers_sag_as_beams_do_at_second_order(x64):
    """w g L^4 / (8 B): a rod, and a plate in cylindrical bending, clamped in the middle of the held cell."""
    errors = {"rod": [], "plate": []}
    for cells in (8, 16, 32):
        length = 1.0 - 0.5 / cells
        rod = rope_scene(thin.rope(np.linspace([0.0, 0, 0], [1.0, 0, 0], cells + 1)), dt=1e-6, held=[0, 1])
        exact = 0.1 * length**4 / (8 * 0.1)
        errors["rod"].append(deflection(rod) / exact - 1)
        cloth = thin.Cloth(warp=1e3, weft=1e3, shear=500.0, bending=1e-2, density=0.3)
        plate = thin.make_scene(
            mesh=thin.sheet(1.0, 0.1, cells, 1), dt=1e-6, cloth=cloth, held=[0, 1, 2, 3], gravity=NOTHING
        )
        errors["plate"].append(deflection(plate) / (0.3 * length**4 / (8 * 1e-2)) - 1)
    for name, error in errors.items():
        print(f"cantilever, {name} of 8, 16, 32 cells: relative errors {', '.join(f'{e:.2e}' for e in error)}")
        assert abs(error[-1]) < 2e-3, (name, error)
        assert np.all(np.divide(error[:-1], error[1:]) > 3.0), (name, error)


def deflection(scene):
    """Displacement of the tip in a small downward gravity of 1 m/s^2, by linear theory."""
    x = rest_positions(scene)
    move = free(scene)
    load = np.zeros(x.shape)
    load[:, 1] = -np.asarray(scene.mass)
    H = np.asarray(hessian(scene, jnp.asarray(x)))[np.ix_(move, move)]
    up = np.tile([False, True, False], len(x))[move]
    across = 1 if scene.rope is not None else 2  # the vertices of a column move together
    together = np.kron(np.eye(up.sum() // across), np.ones((across, 1)))
    H = together.T @ H[np.ix_(up, up)] @ together
    return -np.linalg.solve(H, together.T @ load.reshape(-1)[move][up])[-1]


def rest_positions(scene):
    count = len(scene.mass)
    if scene.rope is not None:
        return np.linspace([0.0, 0, 0], [1.0, 0, 0], count)
    return thin.sheet(1.0, 0.1, count // 2 - 1, 1).vertices


def test_a_pinned_rod_buckles_at_eulers_load(x64):
    """The softest transverse mode loses its stiffness at pi^2 B / L^2."""
    mesh = thin.rope(np.linspace([0.0, 0, 0], [1.0, 0, 0], 41))
    scene = rope_scene(mesh, stretch=1e4, dt=1e-7, held=[0, 40])
    loads, softest = np.array([0.5, 1.5]), []
    for load in loads:
        x = jnp.asarray(mesh.vertices) * (1 - load / 1e4)
        up = np.arange(4, 3 * 40, 3)
        softest.append(np.linalg.eigvalsh(np.asarray(hessian(scene, x))[np.ix_(up, up)])[0])
    critical = loads[0] + (loads[1] - loads[0]) * softest[0] / (softest[0] - softest[1])
    print(f"Euler load of 40 segments: relative error {critical / (np.pi**2 * 0.1) - 1:.2e}")
    np.testing.assert_allclose(critical, np.pi**2 * 0.1, rtol=5e-3)


def mode_period(scene, state, shape, longest):
    """Period of a vibration along ``shape``, from the first two changes of the sign of its amplitude."""
    one = jax.jit(lambda s: thin.step(scene, s, thin.static_poses(20, dtype=float)))
    times, crossings, before = 0.0, [], None
    while times < longest and len(crossings) < 2:
        now = float(jnp.sum(shape * (state.x[:, 1]) * scene.mass))
        if before is not None and now * before < 0:
            crossings.append(times - 20 * scene.dt * now / (now - before))
        before, state, times = now, one(state), times + 20 * scene.dt
    return 2 * (crossings[1] - crossings[0])


def test_a_rope_pendulum_swings_with_the_period_of_a_hanging_chain(x64):
    """The first mode of a chain: T = 2 pi (2 / 2.40483) sqrt(L / g)."""
    count, length = 33, 1.0
    mesh = thin.rope(np.linspace([0.0, 0, 0], [length, 0, 0], count))
    scene = rope_scene(mesh, bending=0.0, dt=2e-4, gravity=(9.81, 0.0, 0.0), held=[0])
    hung = equilibrium(scene, np.asarray(mesh.vertices))
    s = np.clip((length - mesh.vertices[:, 0]) / length, 0.0, 1.0)
    mode = bessel_0(2.404825557695773 * np.sqrt(s))
    state = thin.initial_state(hung + 0.01 * mode[:, None] * [0, 1.0, 0])
    period = mode_period(scene, state, jnp.asarray(mode), 4.0)
    print(f"pendulum: relative error {period / (4 * np.pi / 2.404825557695773 * np.sqrt(length / 9.81)) - 1:.2e}")
    np.testing.assert_allclose(period, 4 * np.pi / 2.404825557695773 * np.sqrt(length / 9.81), rtol=5e-3)


def bessel_0(x):
    t = (np.arange(200) + 0.5) * np.pi / 200
    return np.mean(np.cos(np.asarray(x)[:, None] * np.sin(t)), axis=1)


def test_waves_run_along_a_string_with_sqrt_of_tension_over_density(x64):
    mesh = thin.rope(np.linspace([0.0, 0, 0], [1.0, 0, 0], 33))
    scene = rope_scene(mesh, bending=0.0, dt=1e-4, held=[0, 32])
    strain = 0.05
    tension, length, density = 1e3 * strain, 1.0 + strain, 0.1 / (1.0 + strain)
    x = np.asarray(mesh.vertices) * (1 + strain)
    mode = np.sin(np.pi * np.asarray(mesh.vertices)[:, 0])
    state = thin.initial_state(x + 1e-3 * mode[:, None] * [0, 1.0, 0])
    period = mode_period(scene, state, jnp.asarray(mode), 1.0)
    print(f"string: relative error {period / (2 * length / np.sqrt(tension / density)) - 1:.2e}")
    np.testing.assert_allclose(period, 2 * length / np.sqrt(tension / density), rtol=2e-3)


@pytest.mark.parametrize("kind", ["cloth", "rope"])
def test_the_error_falls_with_dt_at_first_order(x64, kind):
    make, mesh = (
        (cloth_scene, thin.sheet(0.4, 0.3, 4, 3))
        if kind == "cloth"
        else (rope_scene, thin.rope(np.linspace([0.0, 0, 0], [1.0, 0, 0], 9)))
    )
    x = np.asarray(mesh.vertices)
    state = thin.initial_state(x * [1.02, 1.0, 1.0] + 0.02 * np.cos(9 * x[:, :1]) * [0, 1.0, 0])
    ends = []
    for n in (1, 2, 4, 32):
        scene, end = make(mesh, dt=2e-4 / n, damping=1e-4), state
        for _ in range(n):
            end = run(scene, end, 100)
        ends.append(end.x)
    errors = [float(jnp.abs(x - ends[-1]).max()) for x in ends[:-1]]
    print(f"dt of a {kind}: errors {', '.join(f'{e:.2e}' for e in errors)} m")
    assert all(1.7 < a / b < 2.8 for a, b in itertools.pairwise(errors)), errors
