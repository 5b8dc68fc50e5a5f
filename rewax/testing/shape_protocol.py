"""Checks of the form of a shape: a pytree with declared sizes, and a distance of the right shape."""

from typing import Any

import jax
import jax.numpy as jnp

from rewax.physics.numerics.checks import check_numbers
from rewax.physics.shapes.base import require_shape
from rewax.physics.shapes.sizes import size_numbers
from rewax.testing.traced import named


def check_protocol(shape: Any) -> None:
    """Checks that a ``Shape`` is decorated, its sizes are declared and legal, and its distance has the right form."""
    kind = type(shape).__name__
    try:
        require_shape(shape)
        check_numbers(size_numbers(shape, kind))
        jax.eval_shape(lambda: shape.distance((jnp.ones(5),) * 3))
    except ValueError as error:
        raise AssertionError(str(error)) from error
    declared = {number.name for number in size_numbers(shape, "")}
    for path, _ in jax.tree.leaves_with_path(shape):
        name = jax.tree_util.keystr(path)
        assert name in declared, (
            f"{kind}{name} does not say what it may be: declare it with struct.number(POSITIVE, "
            '"give a length in metres") or another range of rewax.physics.numerics.checks'
        )
    for form in ((5,), (2, 3), ()):
        p = (jnp.ones(form),) * 3
        found = named(f"distance of {kind}", jax.eval_shape, lambda shape, p: shape.distance(p), shape, p)
        legal = isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], tuple) and len(found[1]) == 3
        assert legal, f"distance of {kind} returns {found!r}: return distance, (normal_x, y, z)"
        shapes = [jnp.shape(a) for a in (found[0], *found[1])]
        assert all(s == form for s in shapes), (
            f"distance of {kind} returns arrays of shapes {shapes} for points of shape {form}: compute "
            "with the components p[0], p[1], p[2] alone, and give constants their shape with jnp.zeros_like(p[0])"
        )
    named(f"bounding_radius of {kind}", jax.eval_shape, lambda shape: shape.bounding_radius(), shape)
    if shape.is_bounded:
        named(f"volume of {kind}", jax.eval_shape, lambda shape: shape.volume(), shape)


__all__ = ["check_protocol"]
