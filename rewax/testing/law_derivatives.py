"""Checks of a law's derivatives: exact in float64, close in float32, finite for any deformation."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.mpm import Material
from rewax.physics.mpm.materials import elastic_energy_density
from rewax.testing.law_states import at_start, deformations, response
from rewax.types import Array, PyTree

_SPECIAL = [[1, 1, 1], [1.2, 1.2, 0.9], [1.2, 0.9, 0.9], [1.1, 1.1, 1.1], [1.2, 0.9, 0], [1, 0, 0], [0, 0, 0],
            [1.1, 0.9, -0.5], [1, 1, -1], [1, 1 + 1e-9, 1 - 1e-9]]  # fmt: skip
"""Stretches of particles at rest, with equal stretches, flattened and inverted."""


def check_derivatives(m: Material, F: Array, seed: int) -> None:
    """Checks derivatives by deformation, every number and memory: reverse, forward, difference, float32."""
    rng = np.random.default_rng(seed + 4)
    args = (m, F, jnp.asarray(rng.normal(size=F.shape)), at_start(m, F))
    move = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)) * jnp.maximum(jnp.abs(a), 0.1), args)
    value, back = jax.vjp(response, *args)
    scale = jax.tree.map(lambda a: jnp.sqrt(jnp.mean(a**2)) + 1e-12, value)
    weights = jax.tree.map(lambda a, s: jnp.asarray(rng.normal(size=a.shape)) / s, value, scale)
    gradient = back(weights)
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (args, weights))
    rough = jax.vjp(response, *single[0])[1](single[1])
    rounding = 1e-15 * sum(float(jnp.sum(jnp.abs(w * v))) for w, v in _pairs(weights, value))
    for name, part in _parts(args, move):
        reverse, tangent = _inner(gradient, part), jax.jvp(response, args, part)[1]
        forward = _inner(weights, tangent)
        size = sum(abs(_inner(w, t)) for w, t in zip(weights, tangent, strict=True)) + 1e-9
        assert abs(reverse - forward) < 1e-8 * size, f"reverse and forward derivative by {name} differ: {_ADVICE}"
        errors = []
        for h in (1e-4, 1e-5, 1e-6):
            ends = [response(*jax.tree.map(lambda a, d, h=h: a + h * d, args, part)) for h in (h, -h)]
            error = abs((_inner(weights, ends[0]) - _inner(weights, ends[1])) / (2 * h) - reverse)
            errors.append(max(error - rounding / h, 0.0))
        assert min(errors) < 1e-5 * size, (
            f"the derivative by {name} is {reverse:.6g}, finite differences differ by {min(errors):.2g}: {_ADVICE}"
        )
        assert abs(_inner(rough, part) - reverse) < 1e-2 * size, (
            f"in float32 the derivative by {name} is {_inner(rough, part):.4g}, in float64 {reverse:.4g}: use the "
            "operations of Principal and of divided_differences, which lose no digits where stretches are close"
        )


_ADVICE = "no stop_gradient, integer or jnp.where that hides a branch; divide and take roots away from zero"


def _parts(args: tuple, move: tuple) -> list[tuple[str, tuple]]:
    """Tangents that move one argument at a time, with its name: a path in the material, or the argument."""
    still = jax.tree.map(jnp.zeros_like, args)
    leaves, treedef = jax.tree.flatten(move[0])
    parts = []
    for k, (path, _) in enumerate(jax.tree.leaves_with_path(args[0])):
        only = [a if i == k else 0.0 * a for i, a in enumerate(leaves)]
        parts.append((jax.tree_util.keystr(path)[1:], (treedef.unflatten(only), *still[1:])))
    names = ("the deformation gradient", "the velocity gradient", "memory")
    for k, name in enumerate(names, start=1):
        if jax.tree.leaves(args[k]):
            parts.append((name, tuple(move[i] if i == k else still[i] for i in range(4))))
    return parts


def check_finite(material: Material, seed: int) -> None:
    """Checks that values and derivatives of flattened, inverted and undeformed particles are finite in float32."""
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), material)
    F = deformations(np.random.default_rng(seed), 0.0, np.array(_SPECIAL, float)).astype(jnp.float32)
    energy = elastic_energy_density(
        single, jnp.concatenate([F, jnp.eye(3) * jnp.array([2.0, 3.0, 5.0])[:, None, None]])
    )
    assert np.isfinite(energy).all(), (
        f"the energy of stretches {([*_SPECIAL, 2.0, 3.0, 5.0])[int(np.argmin(np.isfinite(energy)))]} is not finite: "
        "continue it smoothly beyond the strain at which its formula ends"
    )
    args = (single, F, jnp.zeros_like(F), at_start(material, F))
    value, back = jax.vjp(response, *args)
    for leaf in jax.tree.leaves((value, back(jax.tree.map(jnp.ones_like, value)))):
        bad = ~np.isfinite(leaf).reshape(len(leaf), -1).all(axis=1) if leaf.ndim and len(leaf) == len(F) else None
        assert np.isfinite(leaf).all(), (
            "values or derivatives are not finite for flattened, inverted or undeformed particles"
            + (f", for stretches {_SPECIAL[int(np.argmax(bad))]}" if bad is not None else "")
            + ": keep logarithms, roots and divisions away from zero (Stretches.log is)"
        )


def _inner(a: PyTree, b: PyTree) -> float:
    return sum(float(jnp.vdot(x, y)) for x, y in _pairs(a, b))


def _pairs(a: PyTree, b: PyTree) -> Iterator[tuple[Array, Array]]:
    return zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)


__all__ = ["check_derivatives", "check_finite"]
