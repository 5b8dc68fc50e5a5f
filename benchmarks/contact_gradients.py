"""Do gradients through contact point where the landscape slopes?

A ball is dropped onto a plane and slides; a ball pushes a box that rests on a plane with friction. For 256 starts the
gradient of the outcome (0.5 s later) is compared with the slope of the landscape, the central difference at 1 cm and
1 cm/s: cosine (median and lowest tenth), mean and spread of the derivative by the first component (the ball's height,
the hand's place). And how deep a ball and a box sink at rest. In double precision.

    python benchmarks/contact_gradients.py
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from rewax.physics import rigid
from rewax.physics.rigid import Penalty
from rewax.training import enable_compilation_cache

DURATION = 0.5
OPTION = '<option timestep="0.004" integrator="Euler" cone="pyramidal" iterations="20"/>'
DEFAULT = '<default><geom contype="0" conaffinity="0"/><pair friction="0.5 0.5 0.005 0.0001 0.0001"/></default>'
BALL = f"""<mujoco>{OPTION}{DEFAULT}<worldbody><geom name="floor" type="plane" size="5 5 1"/>
  <body name="ball" pos="0 0 0.1"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <joint type="hinge" axis="0 1 0"/><geom name="ball" size="0.1" mass="1"/></body></worldbody>
  <contact><pair geom1="floor" geom2="ball"/></contact></mujoco>"""
PUSH = f"""<mujoco>{OPTION}{DEFAULT}<worldbody><geom name="floor" type="plane" size="5 5 1"/>
  <body name="box" pos="0 0 0.1"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <joint type="hinge" axis="0 1 0"/><geom name="box" type="box" size="0.1 0.1 0.1" mass="1"/></body>
  <body name="hand" pos="-0.2 0 0.1"><joint name="hand" type="slide" axis="1 0 0"/>
    <geom name="hand" size="0.1" mass="1"/></body></worldbody>
  <actuator><motor joint="hand"/></actuator>
  <contact><pair geom1="floor" geom2="box"/><pair geom1="box" geom2="hand"/></contact></mujoco>"""


class Law(NamedTuple):
    """A contact law and a substep."""

    name: str
    dt: float
    solref: tuple[float, ...] = ()
    solimp: tuple[float, ...] = ()
    margin: float = 0.0
    penalty: Penalty | None = None


def laws() -> list[Law]:
    """MuJoCo's default, the soft onset at several substeps, and springs and dampers with and without an onset."""
    soft = {"solref": (0.02, 1.0), "solimp": (1e-4, 0.95, 0.02, 0.5, 2.0)}
    found = [Law("MuJoCo's default", 1 / n, (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)) for n in (120, 480)]
    found += [Law("soft onset, 2 cm", 1 / n, **soft) for n in (120, 240, 480)]
    found += [Law("soft onset, 2 cm, margin 1 cm", 1 / 240, **soft, margin=0.01)]
    # 1 kg: critical damping of a spring of 4000 N/m is 126 N s/m.
    for damping, onset, by_depth in ((100.0, 0.0, 0.0), (100.0, 0.01, 0.0), (100.0, 0.02, 0.0), (0.0, 0.0, 5e3)):
        law = Penalty(stiffness=4e3, damping=damping, friction_damping=50.0, onset=onset, depth_damping=by_depth)
        how = "damping by depth" if by_depth else f"onset {100 * onset:g} cm"
        found += [Law(f"springs and dampers, {how}", 1 / n, penalty=law) for n in (240, 960)]
    return found


def load(mjcf: str, law: Law) -> rigid.RigidModel:
    model = rigid.load(mjcf, dt=law.dt, penalty=law.penalty)
    if law.penalty is not None:
        return model
    pairs = model.parameters["pair_solref"].shape[0]
    return model.with_parameters(
        pair_solref=jnp.tile(jnp.asarray(law.solref), (pairs, 1)),
        pair_solimp=jnp.tile(jnp.asarray(law.solimp), (pairs, 1)),
        pair_margin=jnp.full(pairs, law.margin),
    )


def drop(model: rigid.RigidModel, start: jax.Array) -> jax.Array:
    """start: height [m], forward and vertical velocity [m/s]. Outcome: x + z + 0.1 forward velocity."""
    qpos, qvel = jnp.zeros(3).at[1].set(start[0]), jnp.zeros(3).at[:2].set(start[1:])
    state = rigid.step(model, rigid.initial_state(model, qpos, qvel), num_substeps=round(DURATION / model.dt))
    return state.qpos[0] + state.qpos[1] + 0.1 * state.qvel[0]


def push(model: rigid.RigidModel, start: jax.Array) -> jax.Array:
    """start: place of the hand [m], force [N], velocity [m/s]. Outcome: place of the box."""
    qpos, qvel = jnp.zeros(4).at[3].set(start[0]), jnp.zeros(4).at[3].set(start[2])
    qpos = qpos.at[1].set(-0.002)
    state = rigid.initial_state(model, qpos, qvel)
    return rigid.step(model, state, start[1:2], num_substeps=round(DURATION / model.dt)).qpos[0]


def rest_depth(model: rigid.RigidModel) -> jax.Array:
    """How deep the first body lies after 2 s [m]."""
    return -rigid.step(model, rigid.initial_state(model), num_substeps=round(2.0 / model.dt)).qpos[1]


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this study."""

    starts: int = 256
    step: float = 0.01
    """Of the central difference [m, m/s, N]."""


def main(args: Args) -> None:
    jax.config.update("jax_enable_x64", True)
    enable_compilation_cache()
    rng = np.random.default_rng(0)
    ranges = {"ball": ((0.05, 0.35), (0.5, 2.0), (-1.0, 0.0)), "box": ((-0.1, -0.02), (6.0, 12.0), (0.0, 0.5))}
    starts = {
        name: jnp.asarray(np.stack([rng.uniform(low, high, args.starts) for low, high in bounds], axis=1))
        for name, bounds in ranges.items()
    }
    gradients = {
        name: jax.jit(jax.vmap(jax.value_and_grad(function, argnums=1), (None, 0)))
        for name, function in (("ball", drop), ("box", push))
    }
    values = {name: jax.jit(jax.vmap(function, (None, 0))) for name, function in (("ball", drop), ("box", push))}
    depth = jax.jit(rest_depth)
    columns = ("law", "dt", "task", "cosine", "lowest tenth", "mean: gradient / slope", "spread", "rest depth")
    print("| " + " | ".join(columns) + " |")
    print("|---|---|---|---|---|---|---|---|")
    for law in laws():
        for name, mjcf in (("ball", BALL), ("box", PUSH)):
            model = load(mjcf, law)
            gradient = np.asarray(gradients[name](model, starts[name])[1])
            assert np.isfinite(gradient).all(), law
            slopes = []
            for step in np.eye(3) * args.step:
                ahead, behind = (values[name](model, starts[name] + sign * step) for sign in (1, -1))
                slopes.append(np.asarray((ahead - behind) / (2 * args.step)))
            slope = np.stack(slopes, axis=1)
            norms = np.linalg.norm(gradient, axis=1) * np.linalg.norm(slope, axis=1)
            cosine = np.sum(gradient * slope, axis=1) / np.maximum(norms, 1e-12)
            found, true = gradient[:, 0], slope[:, 0]
            numbers = (
                f"{np.median(cosine):.4f} | {np.quantile(cosine, 0.1):.3f} | {found.mean():.3g} / {true.mean():.3g} | "
                f"{found.std():.2g} / {true.std():.2g} | {1e3 * float(depth(model)):.1f} mm"
            )
            print(f"| {law.name} | 1/{round(1 / law.dt)} | {name} | {numbers} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
