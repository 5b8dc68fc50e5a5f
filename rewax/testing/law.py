"""The check of a material's laws: what any law must obey, and what its derivatives must be."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.report import recorded
from rewax.physics import mpm
from rewax.physics.mpm import Fluid, Grid, Material
from rewax.physics.mpm.material_checks import check_material
from rewax.physics.mpm.materials import elastic_energy_density, kirchhoff_stress, respond
from rewax.physics.numerics import components as cp
from rewax.physics.shapes import fill_box
from rewax.types import Array, PyTree

_NUM = 64
"""Deformations at a time."""
_SPECIAL = [[1, 1, 1], [1.2, 1.2, 0.9], [1.2, 0.9, 0.9], [1.1, 1.1, 1.1], [1.2, 0.9, 0], [1, 0, 0], [0, 0, 0],
            [1.1, 0.9, -0.5], [1, 1, -1], [1, 1 + 1e-9, 1 - 1e-9]]  # fmt: skip
"""Stretches of bodies at rest, with repeated stretches, flattened and inverted."""


def check_law(
    material: Material, *, strain: float = 0.1, seed: int = 0, notify: Callable[[str], None] | None = print
) -> None:
    """Check the laws of a material, one's own or those of rewax.

    Numbers are legal. Elastic stress is objective and isotropic, zero at rest, there Hooke's with the law's ``moduli``
    (a fluid's: with its ``sound_speed``), and everywhere the derivative of its energy. Flow depends on the frame in no
    way, and leaves what does not flow as it was to the bit. Derivatives by deformation and by every number: reverse
    equals forward equals finite difference in float64; float32 is close to that; they are finite for flattened and
    inverted particles too. A block of particles at ``mpm.largest_stable_dt`` is stable. All programs run in C++, where
    there is a compiler.

    Args:
      material: with one number for each parameter.
      strain: largest logarithmic strain of the random deformations [-].
      seed: of the deformations.
      notify: gets a line for each part; None: silence.

    Raises:
      AssertionError: a sentence that names what is wrong, and what helps.
      ValueError: a number that its law does not allow.

    Example:
      >>> check_law(Material(density=1e3, elasticity=Hencky(youngs_modulus=1e5, poissons_ratio=0.3)))
    """
    check_material(material)
    say = notify if notify is not None else lambda line: None
    with jax.enable_x64(True):
        double = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), material)
        F = _deformations(np.random.default_rng(seed), strain)
        say("stress: objective, isotropic, Hooke's at rest, derivative of the energy")
        _check_stress(double, F, seed)
        say("flow: objective, exact where nothing flows")
        _check_flow(double, F, seed)
        say("derivatives: reverse, forward, finite difference; float32; finite for any deformation")
        _check_derivatives(double, F, seed)
    _check_finite(material, seed)
    say("a block of particles at the largest stable dt")
    scene, state = _block(material)
    _check_stable(scene, state)
    say("where it runs")
    _check_lowered(scene, state, say)
    say("passed")


def _deformations(rng: np.random.Generator, strain: float, stretches: np.ndarray | None = None) -> Array:
    """Random rotations times stretches times random rotations, (_NUM, 3, 3)."""
    s = np.exp(rng.uniform(-strain, strain, (_NUM, 3))) if stretches is None else stretches
    return jnp.asarray(_rotations(rng, len(s)) @ (s[:, :, None] * _rotations(rng, len(s))))


def _rotations(rng: np.random.Generator, num: int) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(num, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None, :]
    return q * np.linalg.det(q)[:, None, None]


@jax.jit
def _response(material: Material, F: Array, C: Array, memory: tuple[Array, ...]) -> tuple[Array, Array, tuple]:
    r = respond(material, cp.split_matrix(F), velocity_gradient=cp.split_matrix(C), memory=memory)
    return cp.join_matrix(r.F), cp.join_matrix(r.stress), r.memory


def _at_start(material: Material, F: Array) -> tuple[Array, ...]:
    return tuple(jnp.full(F.shape[0], a, F.dtype) for a in material.initial_memory)


def _check_stress(m: Material, F: Array, seed: int) -> None:
    stress = jax.jit(kirchhoff_stress)
    tau, Q = stress(m, F), jnp.asarray(_rotations(np.random.default_rng(seed + 1), _NUM))
    size = _size(tau)
    _near(stress(m, F @ Q), tau, size, "elastic stress changes when the body is turned before it deforms",
          "let principal_stress treat all axes alike")  # fmt: skip
    _near(stress(m, Q @ F), Q @ tau @ jnp.swapaxes(Q, 1, 2), size, "elastic stress does not turn with the body",
          "let it depend on stretches alone")  # fmt: skip
    rest, dF = jnp.broadcast_to(jnp.eye(3), F.shape), jnp.asarray(np.random.default_rng(seed).normal(size=F.shape))
    at_rest, tangent = jax.jvp(lambda F: kirchhoff_stress(m, F), (rest,), (dF,))
    fluid = isinstance(m.elasticity, Fluid)
    mu, lam = (0.0, m.density * m.elasticity.sound_speed(m.density) ** 2) if fluid else m.elasticity.moduli()
    _near(at_rest, 0.0 * at_rest, lam + 2 * mu, "stress at rest is not zero", "subtract it")
    sym = 0.5 * (dF + jnp.swapaxes(dF, 1, 2))
    hooke = 2 * mu * sym + lam * jnp.trace(sym, axis1=1, axis2=2)[:, None, None] * jnp.eye(3)
    source = "density sound_speed^2 as the bulk modulus" if fluid else "moduli() as Lame parameters"
    what = f"stress of small strains is not Hooke's with {source}"
    _near(tangent, hooke, _size(hooke), what, "correct one of both", 1e-6)
    energy = jax.jit(lambda F: elastic_energy_density(m, F))
    P = jax.grad(lambda F: jnp.sum(elastic_energy_density(m, F)))(F)
    factor = None if m.plasticity is None else m.plasticity.stiffness(_at_start(m, F))
    tau = tau if factor is None else _expand(factor) * tau
    what = "stress is not the derivative of energy by deformation, tau_i = s_i dpsi/ds_i"
    _near(P @ jnp.swapaxes(F, 1, 2), tau, size, what, "correct one of both")
    _near(energy(rest), 0.0 * energy(rest), lam + mu, "energy at rest is not zero", "subtract it")


def _check_flow(m: Material, F: Array, seed: int) -> None:
    zeros, memory = jnp.zeros_like(F), _at_start(m, F)
    m = m.replace(viscosity=None, muscle=None)
    new, tau, after = _response(m, F, zeros, memory)
    Q = jnp.asarray(_rotations(np.random.default_rng(seed + 2), _NUM))
    turned, tau_turned, after_turned = _response(m, Q @ F, zeros, memory)
    for one, other, size, what in (
        (turned, new if isinstance(m.elasticity, Fluid) else Q @ new, 1.0, "deformation after flow"),
        (tau_turned, Q @ tau @ jnp.swapaxes(Q, 1, 2), _size(tau), "stress after flow"),
        (after_turned, after, 1.0, "memory"),
    ):
        _near(one, other, size, f"{what} does not turn with the body", "let flow depend on stretches alone")
    if m.plasticity is not None:
        tiny = jnp.asarray(_rotations(np.random.default_rng(seed + 3), _NUM)) @ (jnp.eye(3) * (1.0 - 1e-7))
        kept = np.asarray(_response(m, tiny, zeros, memory)[0])
        creeps = (kept != np.asarray(tiny)).any() and np.abs(kept - np.asarray(tiny)).max() < 1e-12
        assert not creeps, (
            "what does not flow changes by rounding, so that volume creeps: give an elongation that is exactly zero "
            "there (mpm.laws.elongation_of)"
        )


def _check_derivatives(m: Material, F: Array, seed: int) -> None:
    rng = np.random.default_rng(seed + 4)
    args = (m, F, jnp.asarray(rng.normal(size=F.shape)), _at_start(m, F))
    move = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)) * jnp.maximum(jnp.abs(a), 0.1), args)
    value, back = jax.vjp(_response, *args)
    scale = jax.tree.map(lambda a: jnp.sqrt(jnp.mean(a**2)) + 1e-12, value)
    weights = jax.tree.map(lambda a, s: jnp.asarray(rng.normal(size=a.shape)) / s, value, scale)
    gradient = back(weights)
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (args, weights))
    rough = jax.vjp(_response, *single[0])[1](single[1])
    for name, part in _parts(args, move):
        reverse, tangent = _inner(gradient, part), jax.jvp(_response, args, part)[1]
        forward = _inner(weights, tangent)
        size = sum(abs(_inner(w, t)) for w, t in zip(weights, tangent, strict=True)) + 1e-9
        assert abs(reverse - forward) < 1e-8 * size, f"reverse and forward derivative by {name} differ: {_ADVICE}"
        errors = []
        for h in (1e-4, 1e-5, 1e-6):
            ends = [_response(*jax.tree.map(lambda a, d, h=h: a + h * d, args, part)) for h in (h, -h)]
            errors.append(abs((_inner(weights, ends[0]) - _inner(weights, ends[1])) / (2 * h) - reverse))
        assert min(errors) < 1e-5 * size, (
            f"the derivative by {name} is {reverse:.6g}, finite differences differ by {min(errors):.2g}: {_ADVICE}"
        )
        assert abs(_inner(rough, part) - reverse) < 1e-2 * size, (
            f"in float32 the derivative by {name} is {_inner(rough, part):.4g}, in float64 {reverse:.4g}: use the "
            "operations of Principal and of divided_differences, which lose no digits where stretches are close"
        )


_ADVICE = "no stop_gradient, integer or jnp.where that hides a branch; divide and take roots away from zero"


def _parts(args: tuple, move: tuple) -> list[tuple[str, tuple]]:
    """A move of one argument at a time, numbers of the material by their paths."""
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


def _check_finite(material: Material, seed: int) -> None:
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), material)
    F = _deformations(np.random.default_rng(seed), 0.0, np.array(_SPECIAL, float)).astype(jnp.float32)
    args = (single, F, jnp.zeros_like(F), _at_start(material, F))
    value, back = jax.vjp(_response, *args)
    for leaf in jax.tree.leaves((value, back(jax.tree.map(jnp.ones_like, value)))):
        bad = ~np.isfinite(leaf).reshape(len(leaf), -1).all(axis=1) if leaf.ndim and len(leaf) == len(F) else None
        assert np.isfinite(leaf).all(), (
            "values or derivatives are not finite for flattened, inverted or undeformed particles"
            + (f", for stretches {_SPECIAL[int(np.argmax(bad))]}" if bad is not None else "")
            + ": keep logarithms, roots and divisions away from zero (Stretches.log is)"
        )


def _block(material: Material) -> tuple[mpm.MPMScene, mpm.MPMState]:
    """A free block of 4^3 particles, two along each cell, that vibrates."""
    spacing = 0.1
    grid = Grid(shape=(10, 10, 10), spacing=spacing)
    limit = 0.999 * float(np.min(mpm.largest_stable_dt(material, grid)))
    x = jnp.asarray(fill_box((0.45, 0.45, 0.45), (0.2, 0.2, 0.2), 0.5 * spacing))
    scene = mpm.make_scene(
        grid=grid, dt=limit, material=material, particle_volume=(0.5 * spacing) ** 3, gravity=(0.0, 0.0, 0.0)
    )
    state = mpm.initial_state(x, scene)
    noise = 0.01 * spacing / limit * jnp.asarray(np.random.default_rng(0).normal(size=x.shape))
    return scene, state.replace(v=noise - jnp.mean(noise, axis=0))


def _check_stable(scene: mpm.MPMScene, state: mpm.MPMState) -> None:
    end = jax.jit(functools.partial(mpm.step, store_every=None))(scene, state, mpm.static_poses(300))
    start, after = (float(mpm.invariants.kinetic_energy(scene, s)) for s in (state, end))
    moving = scene.material.muscle is not None  # type: ignore[union-attr]
    assert np.isfinite(after) and (moving or after < 10.0 * start), (
        f"300 substeps at mpm.largest_stable_dt take a free block's kinetic energy from {start:.3g} to {after:.3g} J: "
        "let moduli(), sound_speed(), dynamic_viscosity() and largest_stiffness say how stiff the law can become"
    )


def _check_lowered(scene: mpm.MPMScene, state: mpm.MPMState, say: Callable[[str], None]) -> None:
    def total(scene: mpm.MPMScene, state: mpm.MPMState) -> Array:
        return sum(jnp.sum(a) for a in jax.tree.leaves(mpm.step(scene, state, mpm.static_poses(2))))  # type: ignore[return-value]

    with recorded() as decisions:
        jax.jit(jax.grad(total, argnums=(0, 1))).lower(scene, state)
    slow = [d for d in decisions if d.reason is not None and "stress_and_momentum" in d.function]
    assert not slow, f"the law runs in XLA, slower than in C++: {slow[0].reason} (docs/lowering.md says what helps)"
    say("in C++" if decisions else "in XLA: there is no C++ here")


def _near(a: PyTree, b: PyTree, size: Any, what: str, remedy: str, tolerance: float = 1e-9) -> None:
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        error = float(jnp.max(jnp.abs(one - other)) / size)
        assert error < tolerance, f"{what} (relative difference {error:.1e}): {remedy}"


def _size(a: Array) -> Array:
    return jnp.maximum(jnp.max(jnp.abs(a)), 1e-30)


def _expand(a: Array) -> Array:
    return a[:, None, None]


def _inner(a: PyTree, b: PyTree) -> float:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return sum(float(jnp.vdot(x, y)) for x, y in pairs)


__all__ = ["check_law"]
