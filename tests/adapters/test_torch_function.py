"""Gradients through JAX into torch, against JAX's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import point_mass

torch = pytest.importorskip("torch", reason="pip install 'rewax[torch]'")

from rewax.adapters.torch_function import to_torch, torch_function  # noqa: E402


def test_a_rollouts_gradient_reaches_a_torch_policy():
    env = point_mass()
    start = env.reset(jax.random.key(0))

    def rewards(actions):
        def one(state, action):
            state = env.step(state, action)
            return state, state.reward

        return jax.lax.scan(one, start, actions)[1]

    actions = torch.full((4, 1), 0.1, requires_grad=True)
    found = torch_function(rewards)(actions)
    (-found.sum()).backward()
    expected, gradient = jax.value_and_grad(lambda a: -rewards(a).sum())(jnp.full((4, 1), 0.1))
    np.testing.assert_allclose(-found.sum().item(), expected, rtol=1e-6)
    np.testing.assert_allclose(actions.grad.numpy(), gradient, rtol=1e-6)


def test_trees_of_floats_and_whole_numbers():
    def function(a, rest):
        return {"product": a * rest["b"][rest["i"]], "i": rest["i"] + 1, "unused": a.sum()}

    a, b = torch.tensor([1.0, 2.0], requires_grad=True), torch.tensor([3.0, 5.0], requires_grad=True)
    out = torch_function(function)(a, {"b": b, "i": torch.tensor(1)})
    assert out["i"].item() == 2 and not out["i"].requires_grad
    out["product"].sum().backward()
    np.testing.assert_allclose(a.grad, [5.0, 5.0])
    np.testing.assert_allclose(b.grad, [0.0, 3.0])


def test_without_gradient_nothing_is_recorded():
    with torch.no_grad():
        out = torch_function(jnp.sin)(torch.ones(2, requires_grad=True))
    assert not out.requires_grad
    np.testing.assert_allclose(out, np.sin(np.ones(2)), rtol=1e-6)


def test_without_gradient_no_pullback_is_computed():
    traced = []

    @jax.custom_vjp
    def sine(x):
        return jnp.sin(x)

    sine.defvjp(lambda x: traced.append(x) or (jnp.sin(x), x), lambda x, g: (jnp.cos(x) * g,))
    function, x = torch_function(sine), torch.ones(2, requires_grad=True)
    with torch.no_grad():
        function(x)
    assert not traced
    function(x).sum().backward()
    assert traced
    np.testing.assert_allclose(x.grad, np.cos(np.ones(2)), rtol=1e-6)


def test_a_whole_number_that_jax_cannot_hold_is_not_wrapped_in_silence():
    function = torch_function(lambda i: i + 1)
    assert int(function(torch.tensor([2**31 - 2]))[0]) == 2**31 - 1
    with pytest.raises(ValueError, match="a tensor is int64 and has a value beyond int32"):
        function(torch.tensor([2**31]))
    with jax.enable_x64(True):
        assert int(function(torch.tensor([2**40]))[0]) == 2**40 + 1


def test_a_float64_tensor_is_not_rounded_in_silence():
    for argument in (torch.ones(2, dtype=torch.float64), np.ones(2)):
        with pytest.raises(
            ValueError, match=r"a tensor is float64, but JAX computes in float32: give tensor\.float\(\)"
        ):
            torch_function(jnp.sin)(argument)
    with jax.enable_x64(True):
        assert torch_function(jnp.sin)(torch.ones(2, dtype=torch.float64)).dtype == torch.float64


def test_torchs_own_check_of_gradients():
    with jax.enable_x64(True):
        x = torch.linspace(0.1, 1.0, 4, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(torch_function(lambda x: jnp.cumprod(jnp.sin(x))), (x,))


def test_random_keys_and_trees_are_named():
    """A state holds a key; its data can cross."""
    state = point_mass().reset(jax.random.key(0))
    with pytest.raises(
        ValueError, match=r"^a leaf is a random key, which cannot be a tensor: pass jax.random.key_data"
    ):
        torch_function(lambda state: state.reward)(state)
    with pytest.raises(ValueError, match=r"^a leaf is a random key"):
        to_torch(state.key)
    with pytest.raises(
        ValueError, match=r"^to_torch takes one array, not a State: use jax.tree.map\(to_torch, tree\)$"
    ):
        to_torch(state)
    crossed = jax.tree.map(to_torch, state.replace(key=jax.random.key_data(state.key)))
    assert float(torch_function(lambda state: state.reward)(crossed)) == float(state.reward)
