"""JAX functions for PyTorch, with gradients: a torch policy learns through the simulation.

    def rewards(actions):                          # JAX: (T, num_actions) -> (T,)
        def one(state, action):
            state = env.step(state, action)
            return state, state.reward
        return jax.lax.scan(one, start, actions)[1]

    loss = -torch_function(rewards)(policy(observation)).sum()
    loss.backward()                                # through env.step into the policy

DLPack passes tensors between the libraries, without a copy if both use the same device.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rewax.adapters.conversion import missing
from rewax.types import Array, PyTree

try:
    import torch  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise missing("PyTorch", "torch") from error


def torch_function(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """A function of torch tensors that calls a function of JAX arrays.

    Args:
      function: a pure function. Its arguments and results are trees (dicts, lists, tuples) of arrays.

    Returns:
      The function of tensors. It is compiled once for each set of shapes. Do not change its results in place.

    Gradient: in reverse mode, once, from all floating-point results to all floating-point arguments. A call that needs
      no gradient stores nothing for one.

    Raises:
      ValueError: an argument is float64, but JAX computes in float32; or it is a random key.
    """

    @functools.partial(jax.jit, static_argnums=0)
    def with_pullback(treedef: Any, floats: dict[int, Array], others: dict[int, Array]) -> Any:
        def of_floats(floats: dict[int, Array]) -> tuple[list[Array], PyTree]:
            leaves = {**floats, **others}
            results = function(*jax.tree.unflatten(treedef, [leaves[i] for i in range(len(leaves))]))
            return [a for a in jax.tree.leaves(results) if _is_float(a)], results

        _, pullback, results = jax.vjp(of_floats, floats, has_aux=True)
        return results, pullback

    forward = jax.jit(function)
    pull_back = jax.jit(lambda pullback, cotangents: pullback(cotangents)[0])

    class Call(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, treedefs: list[Any], is_recorded: bool, *tensors: Any) -> Any:
            leaves = [to_jax(t) for t in tensors]
            if is_recorded and any(ctx.needs_input_grad):
                floats = {i: a for i, a in enumerate(leaves) if _is_float(a)}
                others = {i: a for i, a in enumerate(leaves) if not _is_float(a)}
                results, ctx.pullback = with_pullback(treedefs[0], floats, others)
            else:
                results = forward(*jax.tree.unflatten(treedefs[0], leaves))
            arrays, treedef = jax.tree.flatten(results)
            treedefs.append(treedef)
            ctx.kinds, ctx.num_inputs = [(a.shape, a.dtype) for a in arrays if _is_float(a)], len(leaves)
            outputs = tuple(to_torch(a) for a in arrays)
            ctx.mark_non_differentiable(*(t for t in outputs if not t.is_floating_point()))
            return outputs

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, *gradients: Any) -> Any:
            given = [g for g in gradients if g is None or g.is_floating_point()]
            cotangents = [
                jnp.zeros(*kind) if g is None else to_jax(g) for kind, g in zip(ctx.kinds, given, strict=True)
            ]
            found = pull_back(ctx.pullback, cotangents)
            return None, None, *(to_torch(found[i]) if i in found else None for i in range(ctx.num_inputs))

    def of_tensors(*args: PyTree) -> PyTree:
        leaves, treedef = jax.tree.flatten(args)
        treedefs = [treedef]
        is_recorded = torch.is_grad_enabled()  # within ``forward`` it is always False
        results = Call.apply(treedefs, is_recorded, *(torch.as_tensor(_no_key(leaf)) for leaf in leaves))
        return jax.tree.unflatten(treedefs[1], results)

    return of_tensors


def to_jax(tensor: Any) -> Array:
    """A torch tensor as a JAX array on the same device. Gradient: none.

    Raises:
      ValueError: the tensor is float64 and JAX computes in float32, which would round it; or it is int64, and a value
        does not fit JAX's int32.
    """
    if tensor.dtype == torch.float64 and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            "a tensor is float64, but JAX computes in float32: give tensor.float(), or let JAX compute in float64 with "
            'jax.config.update("jax_enable_x64", True) before anything else'
        )
    if tensor.dtype == torch.int64 and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        fits = torch.iinfo(torch.int32)
        if tensor.numel() and not (fits.min <= int(tensor.min()) and int(tensor.max()) <= fits.max):
            raise ValueError(
                "a tensor is int64 and has a value beyond int32, in which JAX computes: give smaller numbers, or let "
                'JAX compute in 64 bits with jax.config.update("jax_enable_x64", True) before anything else'
            )
    return jnp.from_dlpack(tensor.detach().contiguous())


def to_torch(array: Array) -> Any:
    """A JAX array as a torch tensor on the same device. Gradient: none.

    Raises:
      ValueError: a random key, or a tree of arrays.
    """
    if not hasattr(array, "dtype"):
        raise ValueError(f"to_torch takes one array, not a {type(array).__name__}: use jax.tree.map(to_torch, tree)")
    return torch.from_dlpack(_no_key(array))


def _no_key(leaf: Any) -> Any:
    """The leaf. Raises ValueError if it is a random key, which torch does not know."""
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        raise ValueError(
            "a leaf is a random key, which cannot be a tensor: pass jax.random.key_data(key), and wrap it inside the "
            "function with jax.random.wrap_key_data"
        )
    return leaf


def _is_float(array: Array) -> bool:
    return bool(jnp.issubdtype(array.dtype, jnp.floating))
