"""Networks: invariances and inputs of the encoder, the initial policy, independent critics."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.agents.networks import Critics, Encoder, GaussianActor, Layer, patches

SILU = jax.nn.silu


def encoder():
    return Encoder((8, 16), 8, 8, SILU, 1.0)


def actor(initial_log_std=0.0):
    return GaussianActor(encoder(), (16,), 3, SILU, 1.0, (-5.0, 2.0), initial_log_std)


def observation(seed):
    rng = np.random.default_rng(seed)
    shapes = {"cloud": (10, 3), "joint_q": (2,), "height": ()}
    return {name: jnp.asarray(rng.normal(size=shape), jnp.float32) for name, shape in shapes.items()}


@pytest.fixture(scope="module")
def encode():
    module = encoder()
    params = jax.jit(module.init)(jax.random.key(0), observation(0))
    return jax.jit(lambda obs: module.apply(params, obs))


def test_encoder_does_not_see_the_order_or_the_number_of_points(encode):
    obs = observation(1)
    shuffled = {**obs, "cloud": obs["cloud"][jnp.array([3, 1, 4, 0, 5, 9, 2, 6, 8, 7])]}
    np.testing.assert_allclose(encode(shuffled), encode(obs), rtol=1e-5, atol=1e-6)
    doubled = {**obs, "cloud": jnp.concatenate([obs["cloud"], obs["cloud"]])}
    np.testing.assert_allclose(encode(doubled), encode(obs), rtol=1e-5, atol=1e-6)
    renamed = dict(reversed(obs.items()))
    np.testing.assert_array_equal(encode(renamed), encode(obs))


@pytest.mark.parametrize(
    ("name", "features"), [("cloud", slice(0, 8)), ("joint_q", slice(8, 16)), ("height", slice(8, 16))]
)
def test_encoder_sees_every_observation_in_its_own_features(encode, name, features):
    obs = observation(1)
    change = np.abs(np.asarray(encode({**obs, name: obs[name] + 0.5}) - encode(obs)))
    assert change.shape == (16,)
    assert change[features].max() > 1e-2
    np.testing.assert_array_equal(np.delete(change, features), 0.0)


def test_encoder_moves_with_a_single_point(encode):
    obs = observation(1)
    slope = np.asarray(jax.jacobian(lambda c: encode({**obs, "cloud": c})[:8])(obs["cloud"]))
    assert (np.abs(slope).max(axis=(0, 2)) > 1e-4).all()  # every point counts


@pytest.fixture(scope="module")
def initial_policies():
    """Parameters of 32 initial policies, and their mean and log standard deviation for 32 observations each."""
    module = actor()
    params = jax.jit(jax.vmap(lambda k: module.init(k, observation(0))))(jax.random.split(jax.random.key(1), 32))
    obs = jax.tree.map(lambda *a: jnp.stack(a), *[observation(i) for i in range(32)])
    return params, obs, jax.jit(jax.vmap(jax.vmap(module.apply, (None, 0)), (0, None)))(params, obs)


def test_policy_starts_around_zero_with_sigma_near_one(initial_policies):
    mean, log_std = map(np.asarray, initial_policies[2])
    assert mean.shape == log_std.shape == (32, 32, 3)
    for head in (mean, log_std):
        assert abs(head.mean()) < 0.15
        assert 0.1 < head.std() < 1.0
    assert np.ptp(log_std, axis=1).max() > 0.3  # depends on the observation


def test_initial_log_std_moves_sigma_alone(initial_policies):
    _, obs, (mean, log_std) = initial_policies
    one = jax.tree.map(lambda a: a[0], obs)
    module, key = actor(-1.0), jax.random.split(jax.random.key(1), 32)[0]
    got_mean, got_log_std = jax.jit(lambda key: module.apply(module.init(key, one), one))(key)
    np.testing.assert_allclose(got_mean, mean[0, 0], atol=1e-5)
    np.testing.assert_allclose(got_log_std, log_std[0, 0] - 1.0, atol=1e-5)


def test_log_std_is_clamped_at_both_ends(initial_policies):
    params, obs, (mean, _) = initial_policies
    params = jax.tree.map(lambda a: a[0], params)
    kernel = params["params"]["log_std"]["kernel"]
    params["params"]["log_std"]["kernel"] = 1000.0 * kernel
    got_mean, log_std = jax.jit(jax.vmap(actor().apply, (None, 0)))(params, obs)
    assert log_std.min() == -5.0 and log_std.max() == 2.0
    np.testing.assert_allclose(got_mean, mean[0], atol=1e-5)


def test_critics_share_an_encoder_and_nothing_else():
    module, obs = Critics(encoder(), (16,), 3, SILU, 1.0), observation(2)
    params = jax.jit(module.init)(jax.random.key(2), obs)

    @jax.jit
    @functools.partial(jax.jacobian, has_aux=True)
    def both(params):
        values = module.apply(params, obs)
        return values, values

    slopes, values = both(params)
    slopes = slopes["params"]
    assert values.shape == (3,) and len(np.unique(np.asarray(values))) == 3
    for i in range(3):
        for head in (f"mlp_{i}", f"value_{i}"):
            for leaf in jax.tree.leaves(slopes[head]):
                moved = np.abs(np.asarray(leaf)).reshape(3, -1).max(axis=1) > 0
                np.testing.assert_array_equal(moved, np.arange(3) == i)
    for leaf in jax.tree.leaves(slopes["encoder"]):
        assert (np.abs(np.asarray(leaf)).reshape(3, -1).max(axis=1) > 0).all()


@pytest.mark.parametrize("channels", [1, 3, 4, 5])
def test_a_layer_multiplies_by_its_matrix_and_narrow_ones_need_no_matrix_product(channels):
    layer, x = Layer(16, jnp.tanh, 1.0), jax.random.normal(jax.random.key(3), (7, channels))
    params = layer.init(jax.random.key(4), x)
    kernel = np.asarray(params["params"]["Dense_0"]["kernel"])
    linear = np.asarray(x) @ kernel
    normal = (linear - linear.mean(-1, keepdims=True)) / np.sqrt(linear.var(-1, keepdims=True) + 1e-6)
    np.testing.assert_allclose(layer.apply(params, x), np.tanh(normal), atol=1e-5)
    # jax 0.10.1 does not compile the product of points (num_points, 3) for GPUs
    assert ("dot_general" in str(jax.make_jaxpr(layer.apply)(params, x))) == (channels > 4)


def test_initialisers_under_vmap_draw_what_each_key_draws_alone():
    """Several batched QR decompositions in one program can dead-lock XLA's CPU threads; this test would hang."""
    from rewax.agents.networks import orthogonal

    def draw(key):
        return [orthogonal(1.0)(k, (64, 32)) for k in jax.random.split(key, 6)]

    keys = jax.random.split(jax.random.key(0), 3)
    many = jax.jit(jax.vmap(draw))(keys)
    alone = jax.jit(draw)(keys[1])
    for a, b in zip(many, alone, strict=True):
        np.testing.assert_array_equal(a[1], b)
        np.testing.assert_allclose(b.T @ b, np.eye(32), atol=1e-5)


def test_without_vector_features_vectors_go_in_as_they_are():
    obs = {"b": jnp.array([3.0]), "a": jnp.array([1.0, 2.0])}
    encoder = Encoder((4,), 3, 0, jax.nn.silu, 1.0)
    params = encoder.init(jax.random.key(0), obs)
    assert not jax.tree.leaves(params)
    np.testing.assert_array_equal(encoder.apply(params, obs), [1.0, 2.0, 3.0])


def test_heads_have_a_gain_of_their_own():
    """Orthogonal rows: the norm of each column of the last layer is its gain."""
    obs = {"x": jnp.ones(3)}
    encoder = Encoder((4,), 3, 8, jax.nn.silu, 1.0)
    actor = GaussianActor(encoder, (8,), 2, jax.nn.silu, 1.0, (-5.0, 2.0), head_gain=0.01)
    params = actor.init(jax.random.key(0), obs)["params"]
    for name in ("mean", "log_std"):
        np.testing.assert_allclose(np.linalg.norm(params[name]["kernel"], axis=0), 0.01, rtol=1e-5)
    critics = Critics(encoder, (8,), 2, jax.nn.silu, 2.0, head_gain=0.5)
    params = critics.init(jax.random.key(0), obs)["params"]
    np.testing.assert_allclose(np.linalg.norm(params["value_0"]["kernel"]), 0.5, rtol=1e-5)


def test_an_encoder_of_pictures_is_the_convolution_of_flax():
    """Patches times a matrix are what ``flax.linen.Conv`` computes with the same kernel."""
    picture = jax.random.normal(jax.random.key(0), (13, 18, 2))
    for size, stride in ((4, 4), (3, 2)):
        out = patches(picture, size, stride)
        before = (size - stride + 1) // 2
        after = [max((-(-n // stride) - 1) * stride + size - before - n, 0) for n in (13, 18)]
        conv = nn.Conv(5, (size, size), stride, padding=[(before, after[0]), (before, after[1])], use_bias=False)
        kernel = conv.init(jax.random.key(1), picture)["params"]["kernel"]
        expected = conv.apply({"params": {"kernel": kernel}}, picture)
        assert out.shape[:2] == expected.shape[:2]
        np.testing.assert_allclose(out @ kernel.reshape(-1, 5), expected, atol=1e-5)


def test_an_encoder_sees_only_what_it_is_told_to():
    obs = {"depth": jnp.ones((16, 16, 1)), "joint_q": jnp.ones(3), "particle_q": jnp.ones((5, 3))}
    encoder = Encoder(
        (4,), 3, 0, jax.nn.silu, 1.0, picture_widths=(4, 6), picture_features=7, observe=("depth", "joint_q")
    )
    params = jax.jit(encoder.init)(jax.random.key(0), obs)
    assert set(params["params"]) == {"picture_depth"}

    def features(obs):
        values = encoder.apply(params, obs)
        return values.sum(), values

    grad, values = jax.jit(jax.grad(features, has_aux=True))(obs)
    assert values.shape == (7 + 3,)
    assert not grad["particle_q"].any() and grad["joint_q"].all()
