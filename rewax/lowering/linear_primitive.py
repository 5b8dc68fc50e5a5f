"""Linear maps with a hand-written transpose, for both directions of differentiation and under ``vmap``.

``jax.custom_vjp`` has no forward mode, and ``jax.custom_derivatives.linear_call`` has no batching rule. The JAX
primitive of this module (see "JAX internals: primitives" in JAX's documentation) has both. Inside the rule of a
``jax.custom_jvp``, forward mode (JVP) runs the map, and reverse mode (VJP) runs its transpose.
"""

import functools
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from rewax.lowering.portability import portable
from rewax.types import Array

Arrays = tuple[Array, ...]
Rule = Callable[[Any, Arrays, Arrays], Arrays]
"""``(static, residuals, linear) -> outputs``; all arrays may carry the same additional leading batch axes."""

Shapes = tuple[tuple[tuple[int, ...], Any], ...]
"""Shape and dtype of each output."""


class ByPlatform(NamedTuple):
    """A rule in one form per platform. JAX selects the form when it lowers a program."""

    cpu: Rule
    other: Rule
    scalar: Rule | None = None
    """The rule that ``from_jaxpr`` lowers to scalar operations; None: ``other``."""

    def __call__(self, static: Any, residuals: Arrays, linear: Arrays) -> Arrays:
        return self.cpu(static, residuals, linear)


@runtime_checkable
class Batchable(Protocol):
    """Protocol of ``static``: with it, ``vmap`` does not broadcast residuals that all batch elements share."""

    def batched(self, which: tuple[bool, ...]) -> Self:
        """``static`` under one more ``vmap``; ``which`` tells which residuals have its axis, in front."""
        ...


linear_call_p = Primitive("linear_call")
linear_call_p.multiple_results = True


def linear_call(
    function: Rule,
    transpose: Rule,
    static: Any,
    residuals: Sequence[Array],
    linear: Sequence[Array],
    *,
    like: Sequence[Any] | None = None,
) -> Arrays:
    """``function(static, residuals, linear)``, linear in ``linear``, with ``transpose`` as its transpose.

    Args:
      function: maps arrays to a tuple of arrays. Must accept leading batch axes: ``vmap`` calls it once with all
        arrays batched along axis 0 instead of tracing it again. It may be a ``ByPlatform``.
      transpose: ``(static, residuals, cotangents of the outputs) -> cotangents of linear``; it may be a ``ByPlatform``.
      static: a hashable value. If it is ``Batchable``, residuals without the axis of a ``vmap`` are not broadcast.
      residuals: arrays in which the function need not be linear. Gradient: none (wrap in ``jax.custom_jvp``).
      linear: arrays in which the function is linear. Gradient: exact.
      like: arrays with the shapes and types of the outputs; None: trace the function to infer them.
    """
    if like is None:
        inputs = tuple((a.shape, a.dtype, bool(a.weak_type)) for a in map(jax.typeof, (*residuals, *linear)))
        # Infer shapes from the XLA version, so that tracing never triggers a build.
        plain = function.other if isinstance(function, ByPlatform) else function
        shapes = _shapes(inputs, plain, static, len(residuals), jnp.result_type(float))
    else:
        shapes = tuple((a.shape, a.dtype) for a in like)
    residuals, linear = _varying_alike(residuals, linear)
    out = linear_call_p.bind(
        *residuals,
        *linear,
        function=function,
        transpose=transpose,
        static=static,
        num_residuals=len(residuals),
        out=shapes,
    )
    return tuple(out)


def _varying_alike(*groups: Sequence[Array]) -> list[list[Array]]:
    """The same arrays; inside ``jax.shard_map`` all of them vary over the union of their mesh axes."""
    axes = [_varying_axes(a) for group in groups for a in group]
    union = frozenset().union(*axes)
    if all(own == union for own in axes):
        return [list(group) for group in groups]

    def cast(a: Array) -> Array:
        missing = tuple(sorted(union - _varying_axes(a)))
        return jax.lax.pcast(a, missing, to="varying") if missing else a

    return [[cast(a) for a in group] for group in groups]


def _varying_axes(a: Any) -> frozenset[str]:
    kind = getattr(a if isinstance(a, ShapedArray) else jax.typeof(a), "manual_axis_type", None)
    return frozenset() if kind is None else kind.varying


def no_transpose(static: Any, residuals: Arrays, cotangents: Arrays) -> Arrays:
    """Transpose of a rule without linear arguments. (``linear_call`` refuses second derivatives.)"""
    del static, residuals, cotangents
    return ()


def _run(*args: Array, function: Rule, transpose: Rule, static: Any, num_residuals: int, out: Shapes) -> list[Array]:
    del transpose, out
    return list(function(static, args[:num_residuals], args[num_residuals:]))


def run_elsewhere(*args: Array, function: Rule, **params: Any) -> list[Array]:
    return _run(*args, function=function.other if isinstance(function, ByPlatform) else function, **params)


def run_scalar_form(*args: Array, function: Rule, **params: Any) -> list[Array]:
    scalar = function.scalar if isinstance(function, ByPlatform) else None
    return run_elsewhere(*args, function=function if scalar is None else scalar, **params)


def _abstract_eval(*args: ShapedArray, out: Shapes, **params: Any) -> list[ShapedArray]:
    del params
    if not any(_varying_axes(a) for a in args):
        if any(_explicit_axes(a) for a in args):
            warnings.warn(_EXPLICIT, stacklevel=2)
        return [ShapedArray(*a) for a in out]
    # Inside shard_map, results vary over the same mesh axes as the arguments.
    sharding = jax.sharding.NamedSharding(args[0].sharding.mesh, jax.sharding.PartitionSpec())
    return [ShapedArray(*a, sharding=sharding, manual_axis_type=args[0].manual_axis_type) for a in out]


_EXPLICIT = (
    "an argument is sharded over a mesh with explicit axes, but rewax's functions lose this sharding, and every device "
    "computes everything: call them inside jax.shard_map (docs/gpu.md)"
)


def _explicit_axes(a: ShapedArray) -> bool:
    return any(axis is not None for axis in getattr(a.sharding, "spec", ()))


@functools.lru_cache(maxsize=4096)
def _shapes(args: tuple, function: Rule, static: Any, num_residuals: int, precision: Any) -> Shapes:
    """Shapes of the outputs, from one trace of the function; transformations derive their shapes from these."""
    del precision  # cache key only: jax_enable_x64
    xs = [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in args]
    out = jax.eval_shape(lambda xs: function(static, tuple(xs[:num_residuals]), tuple(xs[num_residuals:])), xs)
    return tuple((a.shape, a.dtype) for a in out)


def _jvp(primals, tangents, *, num_residuals: int, **params):
    residuals, linear = primals[:num_residuals], primals[num_residuals:]
    if not all(isinstance(t, ad.Zero) for t in tangents[:num_residuals]):
        raise NotImplementedError(
            "second derivatives through this function are not available: differentiate the result of one grad or jvp "
            "by finite differences instead"
        )
    out = linear_call_p.bind(*residuals, *linear, num_residuals=num_residuals, **params)
    (dlinear,) = _varying_alike([ad.instantiate_zeros(t) for t in tangents[num_residuals:]])
    return out, linear_call_p.bind(*residuals, *dlinear, num_residuals=num_residuals, **params)


def _transpose(cotangents, *args, function: Rule, transpose: Rule, static: Any, num_residuals: int, out: Shapes):
    del out
    residuals, linear = args[:num_residuals], args[num_residuals:]
    (cotangents,) = _varying_alike([ad.instantiate_zeros(ct) for ct in cotangents])
    shapes = tuple((x.aval.shape, x.aval.dtype) if ad.is_undefined_primal(x) else (x.shape, x.dtype) for x in linear)
    out = linear_call_p.bind(
        *residuals,
        *cotangents,
        function=transpose,
        transpose=function,
        static=static,
        num_residuals=num_residuals,
        out=shapes,
    )
    wanted = [ct if ad.is_undefined_primal(x) else None for ct, x in zip(out, linear, strict=True)]
    return [None] * num_residuals + wanted


def _batch(args, dims, *, static: Any, num_residuals: int, out: Shapes, **params: Any):
    size = next(a.shape[d] for a, d in zip(args, dims, strict=True) if d is not None)
    args = [a if d is None else jnp.moveaxis(a, d, 0) for a, d in zip(args, dims, strict=True)]
    shared = [d is None for d in dims]
    if isinstance(static, Batchable):
        static = static.batched(tuple(not s for s in shared[:num_residuals]))
        shared[:num_residuals] = [False] * num_residuals
    args = [jnp.broadcast_to(a, (size, *a.shape)) if s else a for a, s in zip(args, shared, strict=True)]
    out = tuple(((size, *shape), dtype) for shape, dtype in out)
    results = linear_call_p.bind(*args, static=static, num_residuals=num_residuals, out=out, **params)
    return results, [0] * len(results)


_compiled = jax.jit(linear_call_p.bind, static_argnames=("function", "transpose", "static", "num_residuals", "out"))


@linear_call_p.def_impl
def _impl(*args: Array, **params: Any) -> list[Array]:
    """Outside jit: compiles a program of its own."""
    # Also inside jax.disable_jit: without jit, bind would call this function again.
    with jax.disable_jit(False):
        return _compiled(*args, **params)


linear_call_p.def_abstract_eval(_abstract_eval)
ad.primitive_jvps[linear_call_p] = _jvp
ad.primitive_transposes[linear_call_p] = _transpose
batching.primitive_batchers[linear_call_p] = _batch
_lower_run = mlir.lower_fun(_run, multiple_results=True)


def _lower_on_cpu(context: Any, *args: Any, **params: Any) -> Any:
    """Lowers for a CPU; exported programs hold none of rewax's C++."""
    if not getattr(context.module_context.lowering_parameters, "for_export", False):
        return _lower(_lower_run, context, *args, **params)
    with portable():
        return _lower(_lower_run, context, *args, **params)


def _lower(lower: Callable[..., Any], context: Any, *args: Any, **params: Any) -> Any:
    """Raises ValueError for an axis that ``vmap`` has named: JAX forgets the name before it lowers."""
    try:
        return lower(context, *args, **params)
    except (NameError, AssertionError) as error:
        if not _is_of_a_collective(error):
            raise
        raise ValueError(
            "a function that rewax compiles uses a collective, such as jax.lax.pmean, over an axis of vmap: use it "
            "outside of this function"
        ) from error


def _is_of_a_collective(error: NameError | AssertionError) -> bool:
    """Whether JAX raised it because a collective's axis has no name: JAX fails a bare assertion, or says so."""
    if isinstance(error, NameError):
        return "unbound axis name" in str(error)
    raised_in = traceback.extract_tb(error.__traceback__)[-1].filename
    return not str(error) and Path(jax.__file__).parent in Path(raised_in).parents


_lower_elsewhere = functools.partial(_lower, mlir.lower_fun(run_elsewhere, multiple_results=True))
mlir.register_lowering(linear_call_p, _lower_elsewhere)
mlir.register_lowering(linear_call_p, _lower_on_cpu, platform="cpu")
