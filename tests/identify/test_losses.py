"""Gradients of all losses equal differences in float64; robust ones forget outliers; masks hide points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.identify import losses
from rewax.identify.sinkhorn import sinkhorn_divergence
from rewax.identify.surface import particle_spacing, surface_offsets, surface_residuals
from rewax.sensors import Balls, Camera, World

RNG = np.random.Generator(np.random.PCG64(0))
PARTICLES, CLOUD = RNG.uniform(0.0, 0.3, (20, 3)), RNG.uniform(0.0, 0.3, (12, 3))
MASK = np.arange(12) != 3


def on_grid(x, cloud, mask):
    return losses.occupancy(x, cloud, mask, lower=jnp.zeros(3) - 0.011, spacing=0.07, shape=(6, 6, 6))


def to_surface(x, cloud, mask):
    residuals = surface_residuals(x, cloud, 0.06, jnp.linspace(0.0, 0.02, len(x)))
    return losses.trimmed_mean(losses.huber(residuals, 0.02), mask)


LOSSES = {
    "chamfer": losses.chamfer,
    "one_sided": lambda *a: losses.one_sided_chamfer(*a, delta=0.05, trim=0.2),
    "matched": losses.matched,
    "occupancy": on_grid,
    "surface": to_surface,
}
LOSSES = {name: jax.jit(loss) for name, loss in LOSSES.items()}


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("name", LOSSES)
def test_the_gradient_equals_differences_in_both_modes(name):
    x, cloud, mask = jnp.asarray(PARTICLES), jnp.asarray(CLOUD), jnp.asarray(MASK)
    direction = jnp.asarray(np.random.Generator(np.random.PCG64(1)).normal(size=x.shape))

    def loss(step):
        return LOSSES[name](x + step * direction, cloud, mask)

    reverse, forward = jax.grad(loss)(0.0), jax.jvp(loss, (0.0,), (1.0,))[1]
    h = 1e-6
    central = (loss(h) - loss(-h)) / (2 * h)
    assert abs(float(central)) > 1e-6
    np.testing.assert_allclose([reverse, forward], [central, central], rtol=1e-6)


@pytest.mark.parametrize("name", LOSSES)
def test_absent_points_change_nothing_and_batches_equal_loops(name):
    x, cloud, mask = jnp.asarray(PARTICLES), jnp.asarray(CLOUD), jnp.asarray(MASK)
    value = LOSSES[name](x, cloud, mask)
    moved = cloud.at[3].add(5.0)
    np.testing.assert_allclose(LOSSES[name](x, moved, mask), value, rtol=1e-12)
    absent = 0.0 if name == "surface" else jnp.nan  # residuals have no mask
    grads = [jax.grad(LOSSES[name])(x, points, mask) for points in (cloud, cloud.at[3].set(absent))]
    np.testing.assert_allclose(grads[1], grads[0], rtol=1e-12)
    batch = jnp.stack([x, x + 0.01])
    together = jax.vmap(lambda one: LOSSES[name](one, cloud, mask))(batch)
    np.testing.assert_allclose(together, [LOSSES[name](one, cloud, mask) for one in batch], rtol=1e-12)


@pytest.mark.parametrize("name", ["chamfer", "matched", "occupancy"])
def test_equal_clouds_cost_nothing_with_a_finite_gradient(name):
    x, mask = jnp.asarray(PARTICLES), jnp.ones(20, bool)
    value, grad = jax.value_and_grad(LOSSES[name])(x, x, mask)
    assert abs(float(value)) < 1e-9 and np.isfinite(grad).all()


def test_a_partial_cloud_costs_nothing_one_sided_and_something_two_sided():
    x = jnp.asarray(PARTICLES)
    part, mask = x[:5], jnp.ones(5, bool)
    one_sided = float(jax.jit(losses.one_sided_chamfer)(x, part, mask))
    assert one_sided < 1e-9 < 1e-4 < float(LOSSES["chamfer"](x, part, mask))


def test_huber_is_quadratic_then_linear_and_its_weight_is_its_slope():
    r = jnp.asarray([0.5, -0.5, 3.0, -7.0])
    np.testing.assert_allclose(losses.huber(r, 1.0), [0.125, 0.125, 2.5, 6.5])
    np.testing.assert_allclose(jax.vmap(jax.grad(lambda a: losses.huber(a, 1.0)))(r), losses.huber_weight(r, 1.0) * r)


def test_trimming_forgets_outliers_exactly():
    values, mask = jnp.asarray([1.0, 2.0, 3.0, 1e6, 5.0]), jnp.asarray([True, True, True, True, False])
    assert float(losses.trimmed_mean(values, mask, 0.25)) == 2.0
    with pytest.raises(ValueError, match="trim is 1"):
        losses.trimmed_mean(values, mask, 1.0)


def test_no_points_at_all_cost_nothing():
    x, cloud, none = jnp.asarray(PARTICLES), jnp.asarray(CLOUD), jnp.zeros(12, bool)
    for loss in LOSSES.values():
        value, grad = jax.value_and_grad(loss)(x, cloud, none)
        assert float(value) == 0.0 and not np.any(grad)


def test_frames_are_weighted():
    assert float(losses.over_time(jnp.asarray([1.0, 3.0, 100.0]), jnp.asarray([1.0, 3.0, 0.0]))) == 2.5
    assert float(losses.over_time(jnp.asarray([1.0]), jnp.asarray([0.0]))) == 0.0
    bad = jnp.asarray([1.0, jnp.nan])
    value, slope = jax.value_and_grad(losses.over_time)(bad, jnp.asarray([2.0, 0.0]))
    assert float(value) == 1.0 and slope.tolist() == [1.0, 0.0]


def test_more_markers_than_particles_are_refused():
    with pytest.raises(ValueError, match="there are 3 seen points and 1 particles: give no more points than particles"):
        losses.matched(jnp.zeros((1, 3)), jnp.ones((3, 3)), jnp.ones(3, bool))


def test_depth_knows_how_far_a_ball_has_moved():
    camera = Camera.look_at((0, 0, 0), eye=(0, 0, 1.0), height=24, width=24, near=0.2, far=3.0, gradient=True)

    def world(shift):
        center = jnp.zeros((1, 3)).at[0, 2].add(shift)
        return World(balls=(Balls(center=center, radius=0.2, names=("ball",), counts=(1,)),))

    seen = jax.jit(camera.depth)(world(0.0))

    @jax.jit
    @jax.value_and_grad
    def loss_and_slope(shift, seen):
        return losses.depth_picture(camera, world(shift), seen)

    def loss(shift, seen=seen):
        return float(loss_and_slope(shift, seen)[0])

    holes = jnp.where(jnp.arange(24) < 10, 0.0, seen)  # as cameras write that they see nothing
    assert 0 < loss(0.02, holes) < 1e-2
    h = 1e-6
    central = (loss(0.02 + h) - loss(0.02 - h)) / (2 * h)
    np.testing.assert_allclose(loss_and_slope(0.02, seen)[1], central, rtol=1e-5)
    assert loss(0.0) < 1e-20 and loss(0.02) > 0.5 * 0.01**2


def test_the_sinkhorn_divergence_vanishes_for_equal_clouds_and_has_an_exact_gradient():
    pytest.importorskip("ott", reason="pip install 'rewax[identify]'")
    x, mask = jnp.asarray(PARTICLES), jnp.ones(20, bool)
    assert abs(float(sinkhorn_divergence(x, x, mask, epsilon=0.01))) < 1e-6

    @jax.jit
    def loss(shift):
        return sinkhorn_divergence(
            x + shift * jnp.asarray([1.0, 0.5, 0.0]), jnp.asarray(CLOUD), jnp.asarray(MASK), epsilon=0.01
        )

    h = 1e-4
    central = (loss(h) - loss(-h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(loss)(0.0), central, rtol=1e-3)


def test_a_shift_of_the_body_is_the_residual_of_its_surface():
    """Points on the top of a block: moving them up by 5 mm gives residuals near 5 mm, whatever the block's lattice."""
    axes = [np.arange(8) * 0.03, np.arange(4) * 0.03, np.arange(8) * 0.03]
    block = jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3))
    spacing = particle_spacing(np.asarray(block))
    assert spacing == pytest.approx(0.03, rel=0.15)
    side = np.random.Generator(np.random.PCG64(2)).uniform(0.05, 0.16, (64, 2))
    top = jnp.asarray(np.stack([side[:, 0], np.full(64, 0.105), side[:, 1]], -1))
    width = 0.5 * spacing
    offsets = surface_offsets(block, top, jnp.ones(64, bool), width)
    assert float(jnp.abs(surface_residuals(block, top, width, offsets)).max()) < 2e-3
    lifted = surface_residuals(block, top.at[:, 1].add(0.005), width, offsets)
    assert float(jnp.median(lifted)) == pytest.approx(0.005, rel=0.3)
    inside = surface_residuals(block, top.at[:, 1].add(-0.005), width, offsets)
    assert float(jnp.median(inside)) == pytest.approx(-0.005, rel=0.3)
