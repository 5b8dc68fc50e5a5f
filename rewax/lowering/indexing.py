"""Slices, pads, gathers and scatters of arrays of operation indices. Nothing is computed."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

Values: TypeAlias = np.ndarray
"""The value of a variable: an array of indices into the list of operations."""


def rows(a: Values, axes: Sequence[int]) -> Values:
    """The array with ``axes`` moved to the front and flattened into one."""
    moved = np.moveaxis(a, axes, range(len(axes)))
    return moved.reshape(int(np.prod(moved.shape[: len(axes)])), *moved.shape[len(axes) :])


def gathered(operand: Values, index: np.ndarray, params: dict[str, Any], out: Any, filling: int) -> Values:
    """``jax.lax.gather`` at known indices.

    Args:
      operand: the array to gather from.
      index: start indices; the last axis holds their coordinates.
      params: parameters of the primitive.
      out: type of the result.
      filling: operation for entries out of bounds, in modes that fill.
    """
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    window = tuple(size for axis, size in enumerate(sizes) if axis not in dropped)
    result = np.full((*index.shape[:-1], *window), filling, np.int64)
    batching = tuple(zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True))
    mode = params["mode"]
    if mode == jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS:  # as XLA does if the promise is broken
        mode = jax.lax.GatherScatterMode.CLIP
    for position, where in _windows(index, operand.shape, sizes, numbers.start_index_map, batching, mode):
        result[position] = operand[where].reshape(window)
    batch = [axis for axis in range(len(out.shape)) if axis not in numbers.offset_dims]
    return np.moveaxis(result, range(result.ndim), (*batch, *numbers.offset_dims))


def scattered(
    operand: Values,
    index: np.ndarray,
    updates: Values,
    params: dict[str, Any],
    merge: Callable[[Values, Values], Values] | None,
) -> Values:
    """``jax.lax.scatter``, ``scatter_add`` and so on at known indices.

    Args:
      operand, updates: as in ``jax.lax.scatter``.
      index: start indices; the last axis holds their coordinates.
      params: parameters of the primitive.
      merge: function of old values and updates; None: the updates replace them.
    """
    numbers = params["dimension_numbers"]
    dropped = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    sizes = [1] * operand.ndim
    kept = [axis for axis in range(operand.ndim) if axis not in dropped]
    for axis, of_update in zip(kept, numbers.update_window_dims, strict=True):
        sizes[axis] = updates.shape[of_update]
    batch = [axis for axis in range(updates.ndim) if axis not in numbers.update_window_dims]
    updates = updates.transpose(*batch, *numbers.update_window_dims)
    batching = tuple(zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True))
    result, coordinates = operand.copy(), numbers.scatter_dims_to_operand_dims
    for position, where in _windows(index, operand.shape, sizes, coordinates, batching, params["mode"]):
        update = updates[position].reshape(sizes)
        result[where] = update if merge is None else merge(result[where], update)
    return result


def _windows(
    index: np.ndarray,
    shape: Sequence[int],
    sizes: Sequence[int],
    coordinates: Sequence[int],
    batching: Sequence[tuple[int, int]],
    mode: Any,
) -> Iterator[tuple[tuple[int, ...], tuple[slice, ...]]]:
    """Positions in the array of indices, each with its window of the operand, without windows out of bounds."""
    for position in np.ndindex(index.shape[:-1]):
        start = [0] * len(shape)
        for coordinate, axis in zip(index[position], coordinates, strict=True):
            start[axis] = int(coordinate)
        for axis, of_index in batching:
            start[axis] = position[of_index]
        inside = [max(min(b, n - k), 0) for b, n, k in zip(start, shape, sizes, strict=True)]
        if mode == jax.lax.GatherScatterMode.CLIP or inside == start:
            yield position, tuple(slice(b, b + k) for b, k in zip(inside, sizes, strict=True))


def _broadcast(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    shape = [1] * len(out.shape)
    for size, axis in zip(args[0].shape, params["broadcast_dimensions"], strict=True):
        shape[axis] = size
    return np.broadcast_to(args[0].reshape(shape), out.shape)


def _reshape(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    """Reshapes the operand; ``dimensions`` is the order in which its axes are read."""
    order = params["dimensions"]
    return (args[0] if order is None else args[0].transpose(order)).reshape(out.shape)


def _slice(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    del out
    steps = params["strides"] or (1,) * args[0].ndim
    bounds = zip(params["start_indices"], params["limit_indices"], steps, strict=True)
    return args[0][tuple(slice(*bound) for bound in bounds)]


def _pad(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    """Pads; negative padding crops."""
    values, filling = args
    config = params["padding_config"]
    sizes = [size + max(size - 1, 0) * gap for size, (*_, gap) in zip(values.shape, config, strict=True)]
    front, back = ([max(padding[end], 0) for padding in config] for end in (0, 1))
    padded = np.full([sum(parts) for parts in zip(front, sizes, back, strict=True)], filling, np.int64)
    spots = zip(front, sizes, config, strict=True)
    padded[tuple(slice(begin, begin + size, gap + 1) for begin, size, (*_, gap) in spots)] = values
    cut = [max(-low, 0) for low, *_ in config]
    return padded[tuple(slice(begin, begin + size) for begin, size in zip(cut, out.shape, strict=True))]


PARTS: dict[str, Callable[[list[Values], dict[str, Any], Any], Values]] = {
    "broadcast_in_dim": _broadcast,
    "reshape": _reshape,
    "squeeze": lambda args, params, out: args[0].reshape(out.shape),
    "expand_dims": lambda args, params, out: args[0].reshape(out.shape),
    "transpose": lambda args, params, out: args[0].transpose(params["permutation"]),
    "concatenate": lambda args, params, out: np.concatenate(args, axis=params["dimension"]),
    "rev": lambda args, params, out: np.flip(args[0], params["dimensions"]),
    "tile": lambda args, params, out: np.tile(args[0], params["reps"]),
    "slice": _slice,
    "pad": _pad,
    "stack": lambda args, params, out: np.stack(args, axis=params["axis"]),
}
"""``(arguments, parameters, type of the result) -> result`` by the names of JAX's primitives."""
