"""The implicit step: its equation, its agreement with the explicit one, its derivatives."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from implicit_cases import CASES, TIGHT, known, met, noise, touched
from thin_bodies import LINE, SHEET, STEP, cloth_scene, rope_scene, run

from rewax.physics import thin
from rewax.physics.contact.penalty import Ground, PenaltyContact
from rewax.physics.numerics import components as cp
from rewax.physics.thin import implicit_step, newton
from rewax.status import Status
from rewax.xla_options import unoptimised


@pytest.mark.parametrize("kind", CASES)
def test_the_curvature_is_the_derivative_of_the_slope_and_its_approximation_is_positive(x64, kind):
    scene, state, poses = CASES[kind]()
    there = known(scene, state, poses)
    x = cp.vector(lambda i: state.x[:, i] + 0.002 * jnp.sin(7.0 * jnp.arange(len(state.x)) + i))
    p, q = noise(x, 1), noise(x, 2)

    def row(flat):
        matrix = implicit_step.curvature(scene, there, x, jnp.zeros(()))
        return jnp.stack(matrix(cp.split_vector(flat.reshape(-1, 3))), axis=-1).reshape(-1)

    @functools.partial(jax.jit, compiler_options=unoptimised())
    def everything():
        exact = implicit_step.curvature(scene, there, x, jnp.ones(()))
        slope = jax.jvp(lambda x: implicit_step.slope(scene, there, x), (x,), (p,))[1]
        blocks = implicit_step.blocks(scene, implicit_step.reach(scene), there, x)
        return exact(p), exact(q), slope, jax.vmap(row)(jnp.eye(state.x.size)), blocks

    along, across, expected, H, found = everything()
    scale = float(jnp.abs(jnp.stack(expected)).max())
    np.testing.assert_allclose(jnp.stack(along), jnp.stack(expected), atol=1e-9 * scale)
    np.testing.assert_allclose(newton.inner(along, q), newton.inner(across, p), rtol=1e-9)
    H = np.asarray(H)
    np.testing.assert_allclose(H, H.T, atol=1e-9 * scale)
    assert np.linalg.eigvalsh(H)[0] > 0.9 * float(scene.mass.min()) / scene.dt**2
    own = H.reshape(len(state.x), 3, len(state.x), 3)[np.arange(len(state.x)), :, np.arange(len(state.x))]
    if kind in ("rope", "self-contact"):  # the others are dominated by the bound of bending
        bending = implicit_step.reach(scene)
        for i in range(3):  # the blocks take friction that slides as stiff as one that sticks
            ratio = own[:, i, i] / np.asarray(found.diagonal[i] - bending)
            assert ratio.min() > 0.6 and np.median(ratio) > 0.95 and ratio.max() < 1.02, ratio
            if kind == "rope":
                mixed = own[:, (i + 1) % 3, (i + 2) % 3]
                np.testing.assert_allclose(found.mixed[i], mixed, atol=0.1 * own[:, i, i].max())


@pytest.mark.parametrize("kind", ["cloth", "rope"])
def test_it_approaches_the_explicit_step_at_first_order(x64, kind):
    make, mesh = (cloth_scene, SHEET) if kind == "cloth" else (rope_scene, LINE)
    x = np.asarray(mesh.vertices)
    x = x * [1.02, 1.0, 1.0] + 0.02 * np.cos(9 * x[:, :1]) * [0, 1.0, 0]
    state = thin.initial_state(x)
    exact = run(make(mesh, dt=1e-5, damping=1e-4), state, 2000).x
    ends = []
    for n in (1, 2):
        scene, end = make(mesh, dt=4e-4 / n, damping=1e-4, stepper=TIGHT), state
        for _ in range(n):
            end = run(scene, end, 50)
        ends.append(end)
    errors = [float(jnp.abs(end.x - exact).max()) for end in ends]
    assert 1.6 < errors[0] / errors[1] < 2.4, errors
    assert all(thin.check_status(make(mesh, stepper=TIGHT), end) == 0 for end in ends)


def pushed(scene, state, pins, vertices, poses):
    """A number from two steps of a body whose rest shape is ``vertices``."""
    scene = scene.replace(rest=thin.rest_shape(scene.topology, vertices))
    twice = jax.tree.map(lambda a: jnp.concatenate([a, a[1:] + (a[1:] - a[:1]) * (a.ndim == 3)]), poses)
    end = thin.step(scene, state, twice, pins=pins)
    weights = jnp.cos(jnp.arange(end.x.size)).reshape(end.x.shape)
    return jnp.sum(weights * (end.x + 0.1 * end.v))


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("kind", "bar"),
    [
        ("StVK", 1e-4),
        pytest.param("hinges", 1e-4, marks=SLOW),
        pytest.param("neo-Hookean", 1e-4, marks=SLOW),
        ("rope", 1e-4),
        ("smooth", 1e-6),
        ("self-contact", 1e-4),
    ],
)
def test_reverse_is_forward_is_finite_difference(x64, agree_along, kind, bar):
    if kind == "self-contact":
        scene, state, poses = met()
        scene = scene.replace(stepper=dataclasses.replace(TIGHT, tolerance=1e-12))
    elif kind == "smooth":
        scene, state, poses = touched(contact=None, ground=None, colliders=())
    else:
        scene, state, poses = touched(kind)
    held = scene.topology.held.indices[:, 0]
    pins = jnp.broadcast_to(state.x[held], (2, len(held), 3)) + 0.001 if len(held) else None
    vertices = jnp.asarray(
        {"rope": LINE.vertices}.get(kind, SHEET.vertices)
        if kind != "self-contact"
        else thin.sheet(0.4, 0.2, 8, 4).vertices
    )
    args = (scene, state, pins, vertices)

    def value(*args):
        return pushed(*args, poses)

    rng = np.random.default_rng(1)
    zero = jax.tree.map(jnp.zeros_like, args)
    noisy = [jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(a.shape)), a) for a in args[1:]]
    law = None if scene.self_contact is None else scene.self_contact.replace(max_speed=0.0)
    parts = jax.tree.map(
        lambda a: a * (1.0 + 0.5 * rng.standard_normal(a.shape)), (scene.cloth, scene.rope, scene.contact, law)
    )
    names = dict(zip(("cloth", "rope", "contact", "self_contact"), parts, strict=True))
    directions = {
        "laws": (zero[0].replace(**{k: v for k, v in names.items() if v is not None}), *zero[1:]),
        "state": (zero[0], noisy[0], *zero[2:]),
        "rest shape": (*zero[:3], noisy[2]),
        **({"pins": (*zero[:2], noisy[1], zero[3])} if len(held) else {}),
    }
    step = 1e-8 if kind == "self-contact" else 1e-7  # some closest points move across an edge
    agree_along(value, args, directions, step=step, exact=1e-8, bar=bar)


def stiff_sheet(**changes):
    """Young's modulus 10 MPa: the largest explicit dt is below 100 us."""
    cloth = thin.isotropic_cloth(youngs_modulus=1e7, poissons_ratio=0.3, thickness=5e-4, density=300.0, damping=1e-4)
    given = {"mesh": thin.sheet(0.4, 0.4, 6, 6), "dt": 5e-3, "cloth": cloth, "held": [0, 6]}
    return thin.make_scene(**given | {"stepper": thin.Implicit()} | changes)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_stiff_cloth_takes_long_steps(x64, dtype):
    scene = stiff_sheet()
    with pytest.raises(ValueError, match="largest stable"):
        stiff_sheet(stepper=None, dt=1e-4)
    scene, state = jax.tree.map(
        lambda a: a.astype(dtype), (scene, thin.initial_state(thin.sheet(0.4, 0.4, 6, 6).vertices))
    )
    lows = []
    for _ in range(4):
        state = STEP(scene, state, thin.static_poses(10, dtype=dtype), store_every=None)
        assert thin.check_status(scene, state) == 0
        lows.append(float(state.x[:, 1].min()))
    assert state.x.dtype == dtype
    assert -0.42 < lows[-1] < -0.15  # it swings down and does not stretch
    lengths = jnp.linalg.norm(state.x[jnp.array([1, 2, 3])] - state.x[jnp.array([0, 1, 2])], axis=-1)
    np.testing.assert_allclose(lengths, 0.4 / 6, rtol=0.01)


def test_an_unsolved_step_says_so_and_others_of_the_batch_do_not(x64):
    scene = stiff_sheet(stepper=thin.Implicit(newton_iterations=2))
    rest = thin.initial_state(thin.sheet(0.4, 0.4, 6, 6).vertices)
    torn = rest.replace(x=rest.x * jnp.array([1.3, 1.0, 1.0]))
    lost = rest.replace(x=rest.x.at[10].set(jnp.nan))
    states = jax.tree.map(lambda *a: jnp.stack(a), rest, torn, lost)
    scene = scene.replace(gravity=jnp.zeros(3))

    def one(state):
        end = thin.step(scene, state, thin.static_poses(2, dtype=float))
        return end, thin.check_status(scene, end)

    ends, status = jax.jit(jax.vmap(one))(states)
    assert status[0] == Status.OK
    assert status[1] & Status.UNSOLVED
    assert status[2] & Status.UNSOLVED and status[2] & Status.NAN
    np.testing.assert_allclose(ends.x[0], rest.x, atol=1e-12)
    alone = jax.jit(one)(torn)[0]
    np.testing.assert_allclose(alone.x, ends.x[1], rtol=1e-9, atol=1e-12)


def test_a_step_without_motion_is_an_equilibrium_of_the_explicit_forces(x64):
    mesh = thin.rope(np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 11))
    x = mesh.vertices * [0.8, 1, 1] - 0.25 * np.sin(np.pi * mesh.vertices[:, :1]) * [0, 1.0, 0]
    scene = rope_scene(mesh, bending=1e-3, dt=0.05, drag=4.0, gravity=(0, -9.81, 0), held=[0, 10], stepper=TIGHT)
    end = STEP(scene, thin.initial_state(x), thin.static_poses(200, dtype=float), store_every=None)
    force = thin.internal_force(scene, end.replace(v=jnp.zeros_like(end.v))) + scene.mass[:, None] * scene.gravity
    np.testing.assert_allclose(force[1:-1], 0.0, atol=1e-6 * float(scene.mass.sum()) * 9.81)
    assert float(end.x[:, 1].min()) < -0.2


def test_a_normal_damping_without_an_onset_is_refused():
    contact = PenaltyContact(stiffness=50.0, damping=0.1)
    with pytest.raises(ValueError, match=r"contact\.onset is 0.*give contact\.onset a depth"):
        cloth_scene(contact=contact, stepper=thin.Implicit())


def test_where_all_vertices_are_held_nothing_is_left_to_solve(x64):
    mesh = thin.sheet(0.1, 0.1, 1, 1)
    scene = cloth_scene(mesh, held=range(4), stepper=thin.Implicit())
    pins = mesh.vertices + np.array([0.0, 0.01, 0.0])
    end = STEP(scene, thin.initial_state(mesh.vertices), thin.static_poses(1, dtype=float), pins=pins[None])
    np.testing.assert_allclose(end.x, pins)
    assert thin.check_status(scene, end) == 0


def oblique(contact: bool, dtype):
    """A scene in which one direction, which no axis has, is ten thousand times as stiff as others."""
    n, along = np.ones(3) / np.sqrt(3.0), np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    if contact:
        along = np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    mesh = thin.rope(np.arange(4)[:, None] * 0.01 * along)
    rope = thin.Rope(stretch=1.0 if contact else 1e4, bending=0.0 if contact else 1e-6, density=0.01)
    touched = {
        "ground": Ground(normal=jnp.asarray(n, dtype), height=1e-9),
        "contact": PenaltyContact(stiffness=1e6),
    }
    scene = thin.make_scene(
        mesh=mesh,
        dt=5e-3,
        rope=rope,
        held=[] if contact else [0],
        stepper=thin.Implicit(),
        **touched if contact else {},
    )
    return scene, thin.initial_state(jnp.asarray(mesh.vertices, dtype))


@pytest.mark.parametrize("contact", [False, True], ids=["rope", "ground"])
def test_a_stiff_oblique_direction_has_the_same_gradient_in_float32(contact):
    """A preconditioner that rounding made indefinite ended the iteration at once: no motion, no gradient, no bit."""
    found = []
    for x64, dtype in ((True, jnp.float64), (False, jnp.float32)):
        with jax.enable_x64(x64):
            scene, state = oblique(contact, dtype)

            def moved(gravity, scene=scene, state=state):
                end = thin.step(scene.replace(gravity=gravity), state, thin.static_poses(1 if contact else 2))
                return jnp.sum((end.x - state.x)[-1] * jnp.array([1.0, 2.0, 3.0])), end

            gravity = jnp.array([0.0, -9.81, 0.0], dtype)
            (_, end), slope = jax.jit(jax.value_and_grad(moved, has_aux=True))(gravity)
            assert slope.dtype == dtype and thin.check_status(scene, end) == Status.OK
            found.append([np.asarray(a, np.float64) for a in (end.x - state.x, slope)])
    for exact, single in zip(*found, strict=True):
        np.testing.assert_allclose(single, exact, atol=0.03 * np.abs(exact).max())
