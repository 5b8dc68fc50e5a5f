"""Stock MuJoCo MJX (MJX-JAX) in the audit: ``mjx.step`` in a scan, MuJoCo's default contact parameters.

Reverse mode needs ``iterations=1`` (MuJoCo issue 2259); forward mode follows the solver's loop as it is.
"""

from importlib.metadata import version

import audit_scenes as s
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from audit_protocol import NotSupported, Problem
from mujoco import mjx

VERSION = version("mujoco-mjx")
VARIANTS = {
    "MJX, 1 iteration": "MJX-JAX, reverse mode, iterations=1",
    "MJX, 20 iterations": "MJX-JAX, reverse mode, iterations=20",
    "MJX, forward mode": "MJX-JAX, jax.jacfwd, iterations=20",
}
DT = 2e-3


def build(variant: str, scene: str) -> Problem:
    if scene not in ("slide-rigid", "foot"):
        raise NotSupported("no particles")
    jax.config.update("jax_enable_x64", True)
    is_leg = scene == "foot"
    compiled = mujoco.MjModel.from_xml_string((s.leg_mjcf if is_leg else s.box_mjcf)(DT))
    compiled.opt.iterations = 1 if "1 iteration" in variant else 20
    model = mjx.put_model(compiled, impl="jax")
    start = mjx.make_data(compiled, impl="jax")
    steps = s.substeps(scene, DT)

    def outcome(p: jax.Array) -> jax.Array:
        data = start.replace(qvel=start.qvel.at[0].set(p[0]))
        used = model
        if is_leg:
            data = data.replace(qpos=data.qpos.at[1].set(s.LEG_START[1]), ctrl=p[1:])
        else:
            used = model.replace(pair_friction=model.pair_friction.at[:, :2].set(p[1]))
        end = jax.lax.scan(lambda d, _: (mjx.step(used, d), None), data, None, length=steps)[0]
        return s.LEG_START[0] + end.qpos[0] + 0.2 * end.qpos[1] if is_leg else end.qpos[0]

    differentiate = jax.jacfwd if "forward" in variant else jax.grad
    value, gradient = jax.jit(outcome), jax.jit(differentiate(outcome))
    return Problem(
        value=lambda p: float(value(jnp.asarray(p))),
        gradient=lambda p: np.asarray(gradient(jnp.asarray(p))),
        precision="float64",
        how=VARIANTS[variant],
    )
