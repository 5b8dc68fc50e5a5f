"""Options that ``load`` sets in place of a model's own, and what of a model has no effect on the motion."""

# pyright: reportAttributeAccessIssue=false

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

import mujoco
import numpy as np

from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE, Number, check_numbers
from rewax.physics.rigid.mjcf import LIMITS


class Overrides(TypedDict, total=False):
    """Options of MuJoCo's model, by their names in MJCF."""

    integrator: Literal["Euler", "implicitfast"]
    cone: Literal["pyramidal", "elliptic"]
    """Of friction; elliptic with a ``Penalty`` only, for which it means nothing."""
    gravity: Sequence[float]
    """[m/s^2], three numbers."""
    wind: Sequence[float]
    """Velocity of the medium [m/s], three numbers."""
    density: float
    """Of the medium [kg/m^3]."""
    viscosity: float
    """Of the medium [Pa s]."""
    impratio: float
    """Of frictional to normal impedance."""
    iterations: int
    """Most steps of the solver."""
    noslip_iterations: int
    max_contact_points: int | None
    """So many of the contacts count, the deepest; None: all. MJX's, which models may carry among their custom numbers:
    MuJoCo has no such limit."""
    max_geom_pairs: int | None
    """So many of the pairs of each two kinds of shapes are looked at, those whose bounding spheres are nearest."""
    flags: Mapping[str, bool]
    """Of MJCF's element flag: whether each is enabled."""


_CHOICES = {
    "integrator": {"Euler": mujoco.mjtIntegrator.mjINT_EULER, "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST},
    "cone": {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC},
}
_NUMBERS = {
    "gravity": (FINITE, (3,), "give an acceleration in m/s^2"),
    "wind": (FINITE, (3,), "give a velocity in m/s"),
    "density": (NOT_NEGATIVE, (), "give it in kg/m^3"),
    "viscosity": (NOT_NEGATIVE, (), "give it in Pa s"),
    "impratio": (POSITIVE, (), "give a ratio"),
    "iterations": (POSITIVE, (), "give a whole number"),
    "noslip_iterations": (NOT_NEGATIVE, (), "give a whole number"),
}
_IDLE_FLAGS = ("ENERGY", "FWDINV", "INVDISCRETE")
"""Flags of what MuJoCo computes besides the motion."""


def with_overrides(mj: mujoco.MjModel, overrides: Overrides) -> mujoco.MjModel:
    """A copy of a model with other options; the model itself where there are none.

    Raises:
      ValueError: there is no such option, or it cannot have this value.
    """
    if not overrides:
        return mj
    known = {*_CHOICES, *_NUMBERS, *LIMITS, "flags"}
    mj = copy.copy(mj)
    for name, value in overrides.items():
        if name not in known:
            raise ValueError(
                f"load has no override {name!r}: known are {', '.join(sorted(known))}, and dt for the timestep"
            )
        if name == "flags":
            _set_flags(mj, value)
        elif name in LIMITS:
            _set_limit(mj, name, value)
        elif name in _CHOICES:
            choices = _CHOICES[name]
            if value not in choices:
                raise ValueError(f"{name} is {value!r}: use one of {', '.join(map(repr, choices))}")
            setattr(mj.opt, name, choices[value])  # pyright: ignore[reportArgumentType]
        else:
            legal, shape, remedy = _NUMBERS[name]
            check_numbers([Number(name, value, legal, remedy, shape)])
            if isinstance(getattr(mj.opt, name), int) and not isinstance(value, (int, np.integer)):
                raise ValueError(f"{name} is {value}: {remedy}")
            setattr(mj.opt, name, value)
    return mj


def without_idle_parts(mj: mujoco.MjModel) -> mujoco.MjModel:
    """A copy for MJX without what has no effect on the motion: energy, sensors, integrator and solver (ours)."""
    mj = copy.copy(mj)
    for flag in _IDLE_FLAGS:
        mj.opt.enableflags &= ~int(getattr(mujoco.mjtEnableBit, f"mjENBL_{flag}"))
    mj.sensor_type[:] = mujoco.mjtSensor.mjSENS_CLOCK  # a kind that MJX knows; none is evaluated
    mj.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    mj.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    return mj


def moving_geoms(mj: mujoco.MjModel) -> np.ndarray:
    """Numbers of the geoms whose poses count for the motion: those that may touch and those that tendons wrap."""
    counts = (mj.geom_contype | mj.geom_conaffinity) != 0
    counts[mj.pair_geom1] = counts[mj.pair_geom2] = True
    wraps = np.isin(mj.wrap_type, [mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER])
    counts[mj.wrap_objid[wraps]] = True
    return np.flatnonzero(counts)


def _set_limit(mj: mujoco.MjModel, name: str, value: Any) -> None:
    number = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if value is not None and (not isinstance(value, (int, np.integer)) or value < 1):
        raise ValueError(f"{name} is {value}: give a whole number, at least 1, or None for no limit")
    if value is not None and number < 0:
        raise ValueError(
            f"the model has no {name} to change: write <custom><numeric name='{name}' data='{value}'/></custom>"
        )
    if number >= 0:
        mj.numeric_data[number] = -1 if value is None else value  # where MJX reads it


def _set_flags(mj: mujoco.MjModel, flags: Any) -> None:
    bits = {
        name.split("_", 1)[1].lower(): (field, int(value), kind == "mjENBL")
        for kind, field, enum in (
            ("mjDSBL", "disableflags", mujoco.mjtDisableBit),
            ("mjENBL", "enableflags", mujoco.mjtEnableBit),
        )
        for name, value in enum.__members__.items()
        if name.startswith(kind)
    }
    for name, enabled in flags.items():
        if name not in bits:
            raise ValueError(f"MuJoCo has no flag {name!r}: known are {', '.join(sorted(bits))}")
        field, bit, is_set = bits[name]
        others = getattr(mj.opt, field) & ~bit
        setattr(mj.opt, field, others | bit if bool(enabled) == is_set else others)


__all__ = ["Overrides", "moving_geoms", "with_overrides", "without_idle_parts"]
