"""Which numbers of an array remain, and where, when it is sliced, padded, gathered and so on. Nothing is computed."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

Values: TypeAlias = np.ndarray
"""The value of a variable: an array of indices into the list of operations."""


def rows(a: Values, axes: Sequence[int]) -> Values:
    """The arrays along the other axes, one after the other."""
    moved = np.moveaxis(a, axes, range(len(axes)))
    return moved.reshape(int(np.prod(moved.shape[: len(axes)])), *moved.shape[len(axes) :])


def gathered(operand: Values, index: np.ndarray, params: dict[str, Any], out: Any, filling: int) -> Values:
    """``jax.lax.gather`` at known indices.

    Args:
      operand: what is taken from.
      index: start indices; the last axis holds their coordinates.
      params: of the primitive.
      out: type of the result.
      filling: the operation that stands for numbers out of bounds, where the mode fills.
    """
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    window = tuple(size for axis, size in enumerate(sizes) if axis not in dropped)
    result = np.full((*index.shape[:-1], *window), filling, np.int64)
    batching = tuple(zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True))
    mode = params["mode"]
    if mode == jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS:  # what XLA does where the promise is broken
        mode = jax.lax.GatherScatterMode.CLIP
    for place, where in _windows(index, operand.shape, sizes, numbers.start_index_map, batching, mode):
        result[place] = operand[where].reshape(window)
    batch = [axis for axis in range(len(out.shape)) if axis not in numbers.offset_dims]
    return np.moveaxis(result, range(result.ndim), (*batch, *numbers.offset_dims))


def scattered(
    operand: Values,
    index: np.ndarray,
    updates: Values,
    params: dict[str, Any],
    merge: Callable[[Values, Values], Values] | None,
) -> Values:
    """``jax.lax.scatter`` and its like at known indices.

    Args:
      operand, updates: as there.
      index: start indices; the last axis holds their coordinates.
      params: of the primitive.
      merge: of what is there and an update; None: the update.
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
    for place, where in _windows(index, operand.shape, sizes, coordinates, batching, params["mode"]):
        update = updates[place].reshape(sizes)
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
    """Positions in the array of indices, each with its window of the operand; those out of bounds are left out."""
    for place in np.ndindex(index.shape[:-1]):
        start = [0] * len(shape)
        for coordinate, axis in zip(index[place], coordinates, strict=True):
            start[axis] = int(coordinate)
        for axis, of_index in batching:
            start[axis] = place[of_index]
        inside = [max(min(b, n - k), 0) for b, n, k in zip(start, shape, sizes, strict=True)]
        if mode == jax.lax.GatherScatterMode.CLIP or inside == start:
            yield place, tuple(slice(b, b + k) for b, k in zip(inside, sizes, strict=True))


def _broadcast(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    shape = [1] * len(out.shape)
    for size, axis in zip(args[0].shape, params["broadcast_dimensions"], strict=True):
        shape[axis] = size
    return np.broadcast_to(args[0].reshape(shape), out.shape)


def _reshape(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    """``dimensions`` is the order in which the operand's axes are read."""
    order = params["dimensions"]
    return (args[0] if order is None else args[0].transpose(order)).reshape(out.shape)


def _slice(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    del out
    steps = params["strides"] or (1,) * args[0].ndim
    bounds = zip(params["start_indices"], params["limit_indices"], steps, strict=True)
    return args[0][tuple(slice(*bound) for bound in bounds)]


def _pad(args: list[Values], params: dict[str, Any], out: Any) -> Values:
    """Also by less than nothing, which cuts."""
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
"""Operations by the names of JAX's primitives: their arguments, parameters and the type of their result."""
