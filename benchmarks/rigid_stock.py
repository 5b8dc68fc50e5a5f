"""Stock ``mjx.step`` made differentiable: what ``rewax.physics.rigid`` is compared with.

MJX's solver is a loop that reverse mode refuses. Here its result is held fixed and given the derivative of the balance
of forces at it, by the implicit function theorem; its linear systems are solved without LAPACK, whose batches can
dead-lock a CPU's thread pool; and a rollout keeps a state and the solver's result per step. The rest is MJX's, whose
private names this changes: only in the process that calls ``install``.
"""

# pyright: reportAttributeAccessIssue=false, reportPrivateImportUsage=false

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jax.ad_checkpoint import checkpoint_name
from mujoco import mjx
from mujoco.mjx._src import smooth, solver, support

from rewax.types import Array

STOCK_SOLVE = solver.solve
held = jax.lax.stop_gradient


def cholesky(matrix: Array) -> Array:
    """Lower factor, one column after the other."""
    index = jnp.arange(len(matrix))

    def column(j: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        left, lower = carry
        pivot = jnp.sqrt(jnp.maximum(left[j, j], 1e-30))
        below = jnp.where(index >= j, left[:, j] / pivot, 0.0)
        return left - jnp.outer(below, below), lower.at[:, j].set(below)

    return jax.lax.fori_loop(0, len(matrix), column, (matrix, jnp.zeros_like(matrix)))[1]


def substitute(lower: Array, b: Array) -> Array:
    """x with lower lower^T x = b."""
    size = len(b)

    def forward(j: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        x, rest = carry
        value = rest[j] / lower[j, j]
        return x.at[j].set(value), rest - lower[:, j] * value

    def backward(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        x, rest = carry
        j = size - 1 - i
        value = rest[j] / lower[j, j]
        return x.at[j].set(value), rest - lower[j, :] * value

    y = jax.lax.fori_loop(0, size, forward, (jnp.zeros_like(b), b))[0]
    return jax.lax.fori_loop(0, size, backward, (jnp.zeros_like(b), y))[0]


@jax.custom_vjp
def solve(matrix: Array, lower: Array, b: Array) -> Array:
    """matrix^-1 b by its factor."""
    del matrix
    return substitute(lower, b)


def _solve_forward(matrix: Array, lower: Array, b: Array) -> tuple[Array, tuple[Array, Array]]:
    del matrix
    x = substitute(lower, b)
    return x, (lower, x)


def _solve_backward(kept: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array, Array]:
    lower, x = kept
    w = substitute(lower, cotangent)
    return -0.5 * (jnp.outer(w, x) + jnp.outer(x, w)), jnp.zeros_like(lower), w


solve.defvjp(_solve_forward, _solve_backward)


def implicit_solve(m: mjx.Model, d: mjx.Data) -> mjx.Data:
    """MJX's solver, with the derivative of the balance of forces (pyramidal cones, no dry friction)."""
    out = STOCK_SOLVE(held(m), held(d))
    qacc = checkpoint_name(out.qacc, "qacc")
    jacobian, target = d._impl.efc_J, d._impl.efc_aref
    stiffness = d._impl.efc_D * (held(jacobian) @ qacc - held(target) < 0)
    hessian = held(support.full_m(m, d) + (jacobian.T * stiffness) @ jacobian)
    hessian = 0.5 * (hessian + hessian.T)

    def forces(qacc: Array) -> Array:
        return -stiffness * (jacobian @ qacc - target)

    residual = support.mul_m(m, d, qacc) - d.qfrc_smooth - jacobian.T @ forces(qacc)
    change = -solve(hessian, held(cholesky(hessian)), residual)
    qacc = qacc + (change - held(change))
    force = forces(qacc)
    total = jacobian.T @ force
    return d.tree_replace(
        {
            "qacc": qacc,
            "qfrc_constraint": out.qfrc_constraint + (total - held(total)),
            "_impl.efc_force": out._impl.efc_force + (force - held(force)),
        }
    )


def install() -> None:
    """Change MJX in this process."""

    def factor(m: mjx.Model, d: mjx.Data) -> mjx.Data:
        del m
        return d.tree_replace({"_impl.qLD": cholesky(held(d._impl.M))})

    def cho_solve(factored: Any, b: Array, **options: Any) -> Array:
        del options
        while isinstance(factored[0], tuple):
            factored = factored[0]
        return solve(*factored, b)

    solver.solve = implicit_solve
    smooth.factor_m = factor
    smooth.solve_m = lambda m, d, x: solve(d._impl.M, d._impl.qLD, x)
    jax.scipy.linalg.cho_factor = lambda a, **options: ((a, cholesky(held(a))), True)
    jax.scipy.linalg.cho_solve = cho_solve


def make_rollout(mjcf: str) -> Callable[[Array, Array, Array], Array]:
    """Last positions by first positions, velocities and controls, shape (num_steps, num_actuators)."""
    compiled = mujoco.MjModel.from_xml_string(mjcf)
    m, d0 = mjx.put_model(compiled), mjx.make_data(compiled)

    def step(state: tuple[Array, Array, Array], ctrl: Array) -> tuple[tuple[Array, Array, Array], None]:
        qpos, qvel, warm = state
        d = mjx.step(m, d0.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warm, ctrl=ctrl))
        return (d.qpos, d.qvel, held(d.qacc_warmstart)), None

    step = jax.checkpoint(step, policy=jax.checkpoint_policies.save_only_these_names("qacc"))
    return lambda qpos, qvel, ctrl: jax.lax.scan(step, (qpos, qvel, jnp.zeros_like(qvel)), ctrl)[0][0]
