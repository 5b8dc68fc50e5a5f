"""Linear maps with a hand-written transpose, for both directions of differentiation and under ``vmap``.

``jax.custom_vjp`` would give up forward mode, ``jax.custom_derivatives.linear_call`` has no batching rule. A JAX
primitive of our own (see "JAX internals: primitives" in JAX's documentation) has both: used inside the rule of a
``jax.custom_jvp`` it gives forward mode by running the map and reverse mode by running its transpose.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from rewax.types import Array

Arrays = tuple[Array, ...]
Pass = Callable[[Any, Arrays, Arrays], Arrays]
"""``(static, residuals, linear) -> outputs``; every array may carry further leading batch axes, the same for all."""

linear_pass_p = Primitive("linear_pass")
linear_pass_p.multiple_results = True


def linear_pass(
    function: Pass, transpose: Pass, static: Any, residuals: Sequence[Array], linear: Sequence[Array]
) -> Arrays:
    """``function(static, residuals, linear)``, linear in ``linear``, with ``transpose`` as its transpose.

    Args:
      function: maps arrays to a tuple of arrays. Must accept leading batch axes: ``vmap`` calls it once with all
        arrays batched along axis 0 instead of tracing it anew.
      transpose: ``(static, residuals, cotangents of the outputs) -> cotangents of linear``.
      static: anything hashable.
      residuals: arrays in which the function need not be linear. Gradient: none (wrap in ``jax.custom_jvp``).
      linear: arrays in which the function is linear. Gradient: exact.
    """
    out = linear_pass_p.bind(
        *residuals, *linear, function=function, transpose=transpose, static=static, num_residuals=len(residuals)
    )
    return tuple(out)


def _run(*args: Array, function: Pass, transpose: Pass, static: Any, num_residuals: int) -> list[Array]:
    del transpose
    return list(function(static, args[:num_residuals], args[num_residuals:]))


def _abstract_eval(*args, **params):
    return list(_shapes(tuple((a.shape, a.dtype) for a in args), **params))


@functools.cache
def _shapes(args: tuple, **params) -> tuple[ShapedArray, ...]:
    """Shapes of the outputs. Every transformation asks for them again, and finding out means tracing the pass."""
    out = jax.eval_shape(lambda *xs: _run(*xs, **params), *(jax.ShapeDtypeStruct(*a) for a in args))
    return tuple(ShapedArray(a.shape, a.dtype) for a in out)


def _jvp(primals, tangents, *, num_residuals: int, **params):
    residuals, linear = primals[:num_residuals], primals[num_residuals:]
    if not all(isinstance(t, ad.Zero) for t in tangents[:num_residuals]):
        raise NotImplementedError(
            "second derivatives through this function are not available: differentiate the result of one grad or jvp "
            "by finite differences instead"
        )
    out = linear_pass_p.bind(*residuals, *linear, num_residuals=num_residuals, **params)
    dlinear = [ad.instantiate_zeros(t) for t in tangents[num_residuals:]]
    return out, linear_pass_p.bind(*residuals, *dlinear, num_residuals=num_residuals, **params)


def _transpose(cotangents, *args, function: Pass, transpose: Pass, static: Any, num_residuals: int):
    residuals, linear = args[:num_residuals], args[num_residuals:]
    cotangents = [ad.instantiate_zeros(ct) for ct in cotangents]
    out = linear_pass_p.bind(
        *residuals, *cotangents, function=transpose, transpose=function, static=static, num_residuals=num_residuals
    )
    wanted = [ct if ad.is_undefined_primal(x) else None for ct, x in zip(out, linear, strict=True)]
    return [None] * num_residuals + wanted


def _batch(args, dims, **params):
    size = next(a.shape[d] for a, d in zip(args, dims, strict=True) if d is not None)

    def leading(a: Array, d: int | None) -> Array:
        if d is None:
            return jnp.broadcast_to(a, (size, *a.shape))
        return jnp.moveaxis(a, d, 0)

    out = linear_pass_p.bind(*[leading(a, d) for a, d in zip(args, dims, strict=True)], **params)
    return out, [0] * len(out)


linear_pass_p.def_impl(jax.jit(_run, static_argnames=("function", "transpose", "static", "num_residuals")))
linear_pass_p.def_abstract_eval(_abstract_eval)
ad.primitive_jvps[linear_pass_p] = _jvp
ad.primitive_transposes[linear_pass_p] = _transpose
batching.primitive_batchers[linear_pass_p] = _batch
mlir.register_lowering(linear_pass_p, mlir.lower_fun(_run, multiple_results=True))
