"""Cloth on an incline: at rest below the friction angle, sliding with g (sin a - mu cos a) above; and the net force and
torque of self-contact."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.validation.common import Check, in_float64, save
from rewax.physics import thin
from rewax.physics.contact.penalty import Ground, PenaltyContact

GRAVITY, FRICTION_ANGLE, DURATION = 9.81, 20.0, 0.3
MU = float(np.tan(np.radians(FRICTION_ANGLE)))
ANGLES = {"tiny": (15.0, 19.5, 20.5, 30.0), "small": tuple(np.arange(10.0, 31.0, 2.5)), "full": tuple(range(5, 46))}
STIFFNESS = 200.0


def accelerations(angles: np.ndarray, implicit: bool) -> np.ndarray:
    """Mean acceleration down the plane from rest, for each angle [m/s^2]."""
    mesh = thin.sheet(0.4, 0.3, 4, 3)
    cloth = thin.isotropic_cloth(youngs_modulus=1e5, poissons_ratio=0.3, thickness=5e-3, density=300.0)
    scene = thin.make_scene(
        mesh=mesh,
        dt=2e-3 if implicit else 2e-4,
        cloth=cloth,
        contact=PenaltyContact(
            stiffness=STIFFNESS, damping=1.0, friction_damping=200.0 if implicit else 20.0, friction=MU, onset=1e-4
        ),
        ground=Ground(normal=(0.0, 1.0, 0.0)),
        stepper=thin.Implicit(tolerance=1e-6) if implicit else None,
    )
    poses = thin.static_poses(round(DURATION / scene.dt), dtype=float)

    def slide(angle: jax.Array) -> jax.Array:
        down, into = GRAVITY * jnp.sin(angle), GRAVITY * jnp.cos(angle)
        there = scene.replace(gravity=jnp.stack([down, -into, jnp.zeros(())]))
        x = jnp.asarray(mesh.vertices).at[:, 1].add(-scene.mass * into / STIFFNESS)
        end = thin.step(there, thin.initial_state(x), poses, store_every=None)
        return jnp.sum(scene.mass * end.v[:, 0]) / jnp.sum(scene.mass) / DURATION

    return np.asarray(jax.jit(jax.vmap(slide))(jnp.radians(jnp.asarray(angles, float))))


def net_of_self_contact() -> tuple[float, float]:
    """Net force and torque of self-contact, without friction, over the sums of the forces' and torques' sizes."""
    mesh = thin.sheet(0.4, 0.2, 8, 4)
    x = np.array(mesh.vertices)
    back = x[:, 0] > 0.21
    x[back] = np.stack([0.40155 - x[back, 0], np.full(back.sum(), 0.012), x[back, 2] + 0.003], axis=-1)
    x += 1e-3 * np.random.default_rng(0).standard_normal(x.shape)
    cloth = thin.isotropic_cloth(youngs_modulus=1e5, poissons_ratio=0.3, thickness=5e-3, density=300.0)
    law = thin.SelfContact(thickness=0.015, stiffness=50.0, damping=0.05, max_speed=0.5)
    scene = thin.make_scene(mesh=mesh, dt=1e-4, cloth=cloth, self_contact=law)
    force = np.asarray(thin.self_contact_force(scene, thin.initial_state(x)))
    torque = np.cross(x, force)
    assert np.abs(force).max() > 0.01
    return tuple(float(np.linalg.norm(a.sum(axis=0)) / np.linalg.norm(a, axis=1).sum()) for a in (force, torque))


@in_float64
def run(scale: str = "small") -> dict[str, Any]:
    """Accelerations over angles, by explicit and implicit steps, and what self-contact sums to."""
    angles = np.asarray(ANGLES[scale], float)
    turn = np.radians(angles)
    theory = GRAVITY * np.maximum(np.sin(turn) - MU * np.cos(turn), 0.0)
    results: dict[str, Any] = {"checks": [], "angles": angles, "theory": theory}
    for name, implicit in (("explicit", False), ("implicit", True)):
        a = accelerations(angles, implicit)
        results[name] = a
        off = float(np.abs(a - theory).max() / GRAVITY)
        results["checks"].append(
            Check(
                what=f"{name}: acceleration at {angles[-1]:g} degrees",
                measured=float(a[-1]),
                theory=float(theory[-1]),
                unit="m/s2",
                error=off,
                bar=0.01,
                error_unit="g, at worst",
            )
        )
    for name, net in zip(("force", "torque"), net_of_self_contact(), strict=True):
        results["checks"].append(
            Check(what=f"net {name} of self-contact over its parts", measured=net, theory=0.0, error=net, bar=1e-10)
        )
    return results


def plot(results: dict[str, Any], path: Path | str) -> None:
    figure, panel = plt.subplots(figsize=(5, 3.4))
    panel.plot(results["angles"], results["theory"], "k-", lw=1, label="theory")
    panel.plot(results["angles"], results["explicit"], "o", ms=4, label="explicit")
    panel.plot(results["angles"], results["implicit"], "x", ms=5, label="implicit")
    panel.axvline(FRICTION_ANGLE, color="k", ls=":")
    panel.set(xlabel="angle of the plane [degrees]", ylabel="acceleration down the plane [m/s²]")
    panel.legend(frameon=False, fontsize=8)
    save(figure, path)
