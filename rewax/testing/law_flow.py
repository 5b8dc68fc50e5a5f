"""Checks of plastic flow and memory, viscous and active stress."""

import jax.numpy as jnp
import numpy as np

from rewax.physics.mpm import Fluid, Material
from rewax.physics.mpm.materials import elastic_energy_density, kirchhoff_stress
from rewax.physics.numerics import components as cp
from rewax.testing.law_states import NUM, at_start, expand, near, response, rotations, size_of
from rewax.types import Array


def check_flow(m: Material, F: Array, seed: int) -> None:
    """Checks that flow is objective, raises no energy, keeps what does not flow, and agrees with its stress."""
    zeros, memory = jnp.zeros_like(F), at_start(m, F)
    m = m.replace(viscosity=None, muscle=None)
    new, tau, after = response(m, F, zeros, memory)
    Q = jnp.asarray(rotations(np.random.default_rng(seed + 2), NUM))
    turned, tau_turned, after_turned = response(m, Q @ F, zeros, memory)
    for one, other, size, what in (
        (turned, new if isinstance(m.elasticity, Fluid) else Q @ new, 1.0, "deformation after flow"),
        (tau_turned, Q @ tau @ jnp.swapaxes(Q, 1, 2), size_of(tau), "stress after flow"),
        (after_turned, after, 1.0, "memory"),
    ):
        near(one, other, size, f"{what} does not turn with the body", "let flow depend on stretches alone")
    if m.plasticity is None:
        return
    factor = m.plasticity.stiffness(after)
    elastic = kirchhoff_stress(m, new) if factor is None else expand(factor) * kirchhoff_stress(m, new)
    what = "the deformation after flow is not that of the stretches after flow"
    near(elastic, tau, size_of(tau), what, "return elongation_of(trial, new): new over trial stretch, minus one", 1e-7)
    before, left = (elastic_energy_density(m, a) for a in (F, new))
    assert bool(jnp.all(left <= before + 1e-9 * size_of(before))), (
        "flow raises the elastic energy: map stretches towards those at rest, not away from them"
    )
    _check_without_flow(m, seed)
    if factor is not None:
        far = response(m, F @ F @ F, zeros, memory)[2]
        most = float(jnp.max(jnp.stack([jnp.max(m.plasticity.stiffness(a)) for a in (memory, after, far)])))  # type: ignore[arg-type]
        assert most <= m.plasticity.largest_stiffness * (1.0 + 1e-6), (
            f"stiffness reaches {most:.3g}, but largest_stiffness is {m.plasticity.largest_stiffness:.3g}, with which "
            "the stable substep is computed: raise largest_stiffness, or bound stiffness"
        )


def _check_without_flow(m: Material, seed: int) -> None:
    tiny = jnp.asarray(rotations(np.random.default_rng(seed + 3), NUM)) @ (jnp.eye(3) * (1.0 - 1e-7))
    memory = at_start(m, tiny)
    new, _, after = response(m, tiny, jnp.zeros_like(tiny), memory)
    kept = np.asarray(new)
    creeps = (kept != np.asarray(tiny)).any() and np.abs(kept - np.asarray(tiny)).max() < 1e-12
    assert not creeps, (
        "what does not flow changes by rounding, so that volume creeps: give an elongation that is exactly zero "
        "there (mpm.laws.elongation_of)"
    )
    near(after, memory, 1.0, "memory changes in a body at rest", "change it where something flows alone", 1e-5)


def check_added(m: Material, F: Array, seed: int) -> None:
    """Checks that viscous stress is symmetric, objective, ignores spin, dissipates; that active stress is objective."""
    rng, Fc = np.random.default_rng(seed + 5), cp.split_matrix(F)
    rate, Q = jnp.asarray(rng.normal(size=F.shape)), jnp.asarray(rotations(rng, NUM))
    if m.viscosity is not None:
        viscosity = m.viscosity

        def stress(rate: Array) -> Array:
            return cp.join_matrix(viscosity.stress(Fc, cp.split_matrix(rate)))

        tau, spin = stress(rate), jnp.asarray(rng.normal(size=F.shape))
        _symmetric(tau, "viscous stress")
        spun = stress(rate + spin - jnp.swapaxes(spin, 1, 2))
        near(spun, tau, size_of(tau), "viscous stress feels a rigid rotation", "use (C + C^T) / 2 of velocity_gradient")
        near(stress(0.0 * rate), 0.0 * tau, size_of(tau), "viscous stress at rest is not zero", "let it vanish with C")
        QT = jnp.swapaxes(Q, 1, 2)
        turned = cp.join_matrix(viscosity.stress(cp.split_matrix(Q @ F), cp.split_matrix(Q @ rate @ QT)))
        what = "viscous stress does not turn with the body"
        near(turned, Q @ tau @ QT, size_of(tau), what, "use invariants of velocity_gradient, no fixed directions")
        power = jnp.sum(tau * rate, axis=(1, 2))
        assert float(jnp.min(power)) >= -1e-9 * float(size_of(power)), (
            "viscous stress makes energy, stress : velocity gradient < 0: it has the wrong sign"
        )
    if m.muscle is not None:
        tau, turned = (cp.join_matrix(m.muscle.stress(cp.split_matrix(a))) for a in (F, Q @ F))
        _symmetric(tau, "active stress")
        what = "active stress does not turn with the body"
        near(
            turned, Q @ tau @ jnp.swapaxes(Q, 1, 2), size_of(tau), what, "let it act along deformed directions, F fibre"
        )


def _symmetric(tau: Array, what: str) -> None:
    remedy = "Kirchhoff stress is: else it makes angular momentum"
    near(tau, jnp.swapaxes(tau, 1, 2), size_of(tau), f"{what} is not symmetric", remedy)


__all__ = ["check_added", "check_flow"]
