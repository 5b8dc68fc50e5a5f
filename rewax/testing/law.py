"""``check_law``: the properties that every law of a material must have, and its derivatives."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import mpm
from rewax.physics.mpm import Fluid, Grid, Material
from rewax.physics.mpm.material_checks import check_laws, check_material
from rewax.physics.mpm.materials import elastic_energy_density, kirchhoff_stress
from rewax.physics.shapes import fill_box
from rewax.testing.law_derivatives import check_derivatives, check_finite
from rewax.testing.law_flow import check_added, check_flow
from rewax.testing.law_states import NUM, at_start, deformations, expand, near, rotations, size_of
from rewax.testing.lowered import decisions_of
from rewax.testing.progress import Progress
from rewax.types import Array


def check_law(
    material: Material, *, strain: float = 0.1, seed: int = 0, notify: Callable[[str], None] | None = print
) -> None:
    """Check the laws of a material, your own or those of rewax.

    It checks that

    - all numbers are legal;
    - elastic stress is objective and isotropic, zero at rest, and the derivative of its energy; for small strains it is
      Hooke's law with the law's ``moduli``, or, for a fluid, with its ``sound_speed``;
    - flow is objective, changes particles that do not flow by not one bit, and returns the elongation that belongs to
      its stretches; stiffness is at most ``largest_stiffness``;
    - viscous stress is symmetric, independent of spin, and dissipates energy;
    - active stress is symmetric and rotates with the body;
    - derivatives with respect to deformation and every parameter agree in reverse mode, forward mode and by finite
      differences in float64, nearly agree in float32, and are finite for flattened and inverted particles;
    - a block of particles is stable at ``mpm.largest_stable_dt``;
    - all programs run in C++, if there is a compiler.

    Args:
      material: a material with one number for each parameter.
      strain: largest logarithmic strain of the random deformations [-].
      seed: seed of the deformations.
      notify: called with a line for each part; None: silence.

    Raises:
      AssertionError: a sentence that names what is wrong, and what helps.
      ValueError: a number that its law does not allow, or a method that returns something of the wrong form.
      NotImplementedError: a law lacks a method.

    Example:
      >>> check_law(Material(density=1e3, elasticity=Hencky(youngs_modulus=1e5, poissons_ratio=0.3)))
    """
    check_material(material)
    check_laws(material)
    say = Progress(" + ".join(type(law).__name__ for law in material.laws.values()), notify)
    with jax.enable_x64(True):
        double = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), material)
        F = deformations(np.random.default_rng(seed), strain)
        say("stress: objective, isotropic, Hooke's at rest, derivative of the energy")
        _check_stress(double, F, seed)
        say("flow: objective, exact where nothing flows; added stresses")
        check_flow(double, F, seed)
        check_added(double, F, seed)
        say("derivatives: reverse, forward, finite difference; float32; finite for any deformation")
        check_derivatives(double, F, seed)
    check_finite(material, seed)
    say("a block of particles at the largest stable dt")
    scene, state = _block(material)
    _check_stable(scene, state)
    say("where it runs")
    _check_lowered(scene, state, say)
    say("passed")


def _check_stress(m: Material, F: Array, seed: int) -> None:
    stress = jax.jit(kirchhoff_stress)
    tau, Q = stress(m, F), jnp.asarray(rotations(np.random.default_rng(seed + 1), NUM))
    size = size_of(tau)
    near(stress(m, F @ Q), tau, size, "elastic stress changes when the body is turned before it deforms",
          "let principal_stress treat all axes alike")  # fmt: skip
    near(stress(m, Q @ F), Q @ tau @ jnp.swapaxes(Q, 1, 2), size, "elastic stress does not turn with the body",
          "let it depend on stretches alone")  # fmt: skip
    rest, dF = jnp.broadcast_to(jnp.eye(3), F.shape), jnp.asarray(np.random.default_rng(seed).normal(size=F.shape))
    at_rest, tangent = jax.jvp(lambda F: kirchhoff_stress(m, F), (rest,), (dF,))
    fluid = isinstance(m.elasticity, Fluid)
    mu, lam = (0.0, m.density * m.elasticity.sound_speed(m.density) ** 2) if fluid else m.elasticity.moduli()
    near(at_rest, 0.0 * at_rest, lam + 2 * mu, "stress at rest is not zero", "subtract it")
    sym = 0.5 * (dF + jnp.swapaxes(dF, 1, 2))
    hooke = 2 * mu * sym + lam * jnp.trace(sym, axis1=1, axis2=2)[:, None, None] * jnp.eye(3)
    source = "density sound_speed^2 as the bulk modulus" if fluid else "moduli() as Lame parameters"
    what = f"stress of small strains is not Hooke's with {source}"
    near(tangent, hooke, size_of(hooke), what, "correct one of both", 1e-6)
    energy = jax.jit(lambda F: elastic_energy_density(m, F))
    P = jax.grad(lambda F: jnp.sum(elastic_energy_density(m, F)))(F)
    factor = None if m.plasticity is None else m.plasticity.stiffness(at_start(m, F))
    tau = tau if factor is None else expand(factor) * tau
    what = "stress is not the derivative of energy by deformation, tau_i = s_i dpsi/ds_i"
    near(P @ jnp.swapaxes(F, 1, 2), tau, size, what, "correct one of both")
    near(energy(rest), 0.0 * energy(rest), lam + mu, "energy at rest is not zero", "subtract it")


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


def _check_lowered(scene: mpm.MPMScene, state: mpm.MPMState, say: Progress) -> None:
    decisions = decisions_of(lambda scene, state: mpm.step(scene, state, mpm.static_poses(2)), scene, state)
    slow = [f"{d.function.rpartition('.')[2]} ({d.rule}): {d.reason}" for d in decisions if d.reason is not None]
    assert not slow, f"the law runs in XLA, slower than in C++: {'; '.join(slow)} (docs/lowering.md says what helps)"
    say("in C++" if decisions else "in XLA: there is no C++ here")


__all__ = ["check_law"]
