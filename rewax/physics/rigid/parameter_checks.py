"""Legal values of a rigid model's parameters."""

# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, Legal, Number, any_illegal, check_numbers
from rewax.physics.rigid.mjcf import LIMITS, named, numeric
from rewax.physics.rigid.spring_contacts import Penalty, penalty_numbers
from rewax.types import Array

_NOT_NEGATIVE = {
    "body_mass", "body_inertia", "dof_armature", "dof_damping", "dof_frictionloss", "geom_friction", "geom_size",
    "jnt_stiffness", "pair_friction",
}  # fmt: skip


_RANGES = ("jnt_range", "actuator_ctrlrange", "actuator_forcerange")
_UNIT_VECTORS = ("body_quat", "body_iquat", "geom_quat", "jnt_axis")
_LENGTH_TOLERANCE = 0.01


def parameter_numbers(parameters: Mapping[str, Any]) -> list[Number]:
    """Parameters by the names of MuJoCo's fields, with their legal values."""
    numbers = [
        Number(name, value, NOT_NEGATIVE if name in _NOT_NEGATIVE else FINITE, "give it in MuJoCo's unit")
        for name, value in parameters.items()
    ]
    for name in _RANGES:
        if name in parameters:
            given = parameters[name]
            limits = given if isinstance(given, jax.Array) else np.asarray(given)
            what, width = f"upper minus lower limit of {name}", limits[..., 1] - limits[..., 0]
            numbers.append(Number(what, width, NOT_NEGATIVE, "give the lower limit first"))
    for name in (name for name in parameters if name.endswith("_solimp")):
        given = parameters[name]
        power = (given if isinstance(given, jax.Array) else np.asarray(given))[..., 4]
        part = (power - power.round()) * (power > 1.0)  # MJX's derivative is not finite there
        remedy = "give a power up to 1, or 2 or another integer"
        numbers.append(Number(f"the fractional part of the power of {name}", part, Legal(-1e-6, 1e-6), remedy))
    return numbers


def size_numbers(mj: mujoco.MjModel, size: Any, on_field: np.ndarray) -> list[Number]:
    """How much larger geoms are than when they were loaded, for those whose size is bounded.

    Args:
      mj: the model as it was loaded.
      size: ``geom_size``, shape (num_geoms, 3).
      on_field: ids of geoms that may touch a height field: as many of its cells are searched as they covered.
    """
    if not len(on_field):
        return []
    larger = size[on_field] - 1.0001 * mj.geom_size[on_field]
    remedy = "load the model with the largest sizes: as many cells of the field are searched as they cover"
    return [Number("the growth of geom_size of geoms that may touch height fields", larger, Legal(high=1e-9), remedy)]


def has_invalid_parameters(
    parameters: Mapping[str, Any], gravity: Array, penalty: Penalty | None, mj: mujoco.MjModel, on_field: np.ndarray
) -> Array:
    """Whether a model holds an illegal value, shape (), bool; for traced or replaced values. Gradient: none."""
    numbers = [*parameter_numbers(parameters), Number("gravity", gravity, FINITE, "give an acceleration in m/s^2")]
    numbers += size_numbers(mj, parameters["geom_size"], on_field)
    legal = Legal((1.0 - _LENGTH_TOLERANCE) ** 2, (1.0 + _LENGTH_TOLERANCE) ** 2)
    for name in _UNIT_VECTORS:
        if name in parameters:
            squares = jnp.sum(parameters[name] ** 2, axis=-1)
            numbers.append(Number(f"the squared length of {name}", squares, legal, "divide by its length"))
    return any_illegal(numbers + ([] if penalty is None else penalty_numbers(penalty)))


def check_unit_lengths(parameters: Mapping[str, Any]) -> None:
    """Raises ValueError for a quaternion or a joint axis whose length is not 1; traced ones are not checked."""
    for name in _UNIT_VECTORS:
        value = parameters.get(name)
        if value is None or any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value)):
            continue
        length = np.linalg.norm(np.asarray(value, float), axis=-1)
        wrong = ~(np.abs(length - 1.0) < _LENGTH_TOLERANCE)
        if np.any(wrong):
            row = int(np.flatnonzero(wrong)[0])
            raise ValueError(
                f"{name}[{row}] has length {length[row]:.3g}, but must have length 1: divide by its length"
            )


def check_compiled(mj: mujoco.MjModel) -> None:
    """Raises ValueError for values of a compiled model that MuJoCo accepts although they mean nothing."""
    names = ("key_qpos", "key_mpos", "key_mquat")
    check_numbers([Number(name, getattr(mj, name), FINITE, "correct the model's keyframe") for name in names])
    for field in ("jnt_range", "tendon_range", "actuator_ctrlrange", "actuator_forcerange"):
        kind, _, name = field.partition("_")
        limits = getattr(mj, field)
        if np.any(wrong := limits[:, 0] > limits[:, 1]):
            low, high = limits[np.flatnonzero(wrong)[0]]
            where = named(mj, kind.replace("jnt", "joint"), wrong)
            raise ValueError(f"{where} has the {name} {low:g} to {high:g}: give the lower limit first")
    for name in LIMITS:
        for value in mj.numeric_data[numeric(mj, name)]:
            if not np.isfinite(value) or value != int(value) or value < -1:
                raise ValueError(f"the model's {name} is {value:g}: give an integer, at least 0, or -1 for no limit")
    if np.any(wrong := _massless_dofs(mj)):
        joint = np.isin(np.arange(mj.njnt), mj.dof_jntid[wrong])
        raise ValueError(f"{named(mj, 'joint', joint)} moves no mass: give its body a positive mass and inertia")


def _massless_dofs(mj: mujoco.MjModel) -> np.ndarray:
    """Whether a degree of freedom moves neither mass nor armature, shape (num_dofs,)."""
    mass = np.array(mj.body_mass)
    for body in range(mj.nbody - 1, 0, -1):
        mass[mj.body_parentid[body]] += mass[body]
    return (mass[mj.dof_bodyid] <= 0.0) & (mj.dof_armature <= 0.0)


__all__ = ["check_compiled", "check_unit_lengths", "has_invalid_parameters", "parameter_numbers", "size_numbers"]
