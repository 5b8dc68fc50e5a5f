"""Options that replace a model's own, and the parts of a model that do not affect the motion."""

# pyright: reportAttributeAccessIssue=false

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

import mujoco
import numpy as np

from rewax.physics.numerics.arguments import check_instance, check_integer, check_plain
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE, Number, check_numbers, shown
from rewax.physics.rigid.mjcf import LIMITS


class Overrides(TypedDict, total=False):
    """Options of MuJoCo's model, by their names in MJCF."""

    integrator: Literal["Euler", "implicitfast"]
    """Time integrator, see ``step``."""
    cone: Literal["pyramidal", "elliptic"]
    """Friction cone. Elliptic cones need a ``Penalty``, which ignores the option."""
    gravity: Sequence[float]
    """Gravitational acceleration [m/s^2], three numbers."""
    wind: Sequence[float]
    """Velocity of the medium [m/s], three numbers."""
    density: float
    """Density of the medium [kg/m^3]."""
    viscosity: float
    """Viscosity of the medium [Pa s]."""
    impratio: float
    """Ratio of frictional to normal impedance."""
    iterations: int
    """Largest number of Newton steps of the solver. At least 50 are always allowed, because the derivative assumes that
    the solver has converged."""
    noslip_iterations: int
    """Steps of MuJoCo's noslip solver; rewax supports 0 only."""
    max_contact_points: int | None
    """Number of contacts kept, the deepest; None: all. A limit of MJX, which reads it from the model's custom numerics;
    MuJoCo has none."""
    max_geom_pairs: int | None
    """Number of pairs of each group that are collided, those with the nearest bounding spheres; None: all."""
    flags: Mapping[str, bool]
    """Whether each flag of MJCF's element ``flag`` is enabled."""


_CHOICES = {
    "integrator": {"Euler": mujoco.mjtIntegrator.mjINT_EULER, "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST},
    "cone": {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC},
}
_NUMBERS = {
    "gravity": (FINITE, "give an acceleration in m/s^2", (3,)),
    "wind": (FINITE, "give a velocity in m/s", (3,)),
    "density": (NOT_NEGATIVE, "give it in kg/m^3", ()),
    "viscosity": (NOT_NEGATIVE, "give it in Pa s", ()),
    "impratio": (POSITIVE, "give a ratio", ()),
}
_INTEGERS = {"iterations": 1, "noslip_iterations": 0}
"""Integer options and their least values."""
_IDLE_FLAGS = ("ENERGY", "FWDINV", "INVDISCRETE")
"""Flags of quantities that MuJoCo computes besides the motion."""


def with_overrides(mj: mujoco.MjModel, overrides: Overrides) -> mujoco.MjModel:
    """A copy of a model with other options; the model itself if there are none.

    Raises:
      ValueError: there is no such option, or its value is illegal.
    """
    if not overrides:
        return mj
    known = {*_CHOICES, *_NUMBERS, *_INTEGERS, *LIMITS, "flags"}
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
            if not isinstance(value, str) or value not in choices:
                raise ValueError(f"{name} is {shown(value)}: use one of {', '.join(map(repr, choices))}")
            setattr(mj.opt, name, choices[value])
        elif name in _INTEGERS:
            check_integer(name, value, _INTEGERS[name])
            setattr(mj.opt, name, value)
        else:
            check_plain(name, value, _NUMBERS[name][1])
            check_numbers([Number(name, value, *_NUMBERS[name])])
            setattr(mj.opt, name, value)
    return mj


def check_options(mj: mujoco.MjModel) -> None:
    """Raises ValueError for options with illegal values, which MuJoCo's compiler accepts."""
    for name in _INTEGERS:
        check_integer(f"the model's {name}", getattr(mj.opt, name), 0)
    rules = {**_NUMBERS, "timestep": (POSITIVE, "give load a dt in seconds", ())}
    check_numbers([Number(f"the model's {name}", getattr(mj.opt, name), *rule) for name, rule in rules.items()])


def without_idle_parts(mj: mujoco.MjModel) -> mujoco.MjModel:
    """A copy for MJX without energy and sensors, and without the integrator and solver, which are rewax's own."""
    mj = copy.copy(mj)
    for flag in _IDLE_FLAGS:
        mj.opt.enableflags &= ~int(getattr(mujoco.mjtEnableBit, f"mjENBL_{flag}"))
    mj.sensor_type[:] = mujoco.mjtSensor.mjSENS_CLOCK  # a type that MJX accepts; no sensor is evaluated
    mj.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    mj.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    return mj


def may_touch(mj: mujoco.MjModel) -> np.ndarray:
    """Whether each geom may touch others: it has a contype or conaffinity, or belongs to an explicit pair."""
    touches = (mj.geom_contype | mj.geom_conaffinity) != 0
    touches[mj.pair_geom1] = touches[mj.pair_geom2] = True
    return touches


def moving_geoms(mj: mujoco.MjModel) -> np.ndarray:
    """Ids of the geoms whose poses affect the motion: those that may touch and those that tendons wrap."""
    counts = may_touch(mj)
    wraps = np.isin(mj.wrap_type, [mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER])
    counts[mj.wrap_objid[wraps]] = True
    return np.flatnonzero(counts)


def _set_limit(mj: mujoco.MjModel, name: str, value: Any) -> None:
    number = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if value is not None:
        check_integer(name, value, 1, "give an integer, at least 1, or None for no limit")
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
    check_instance("flags", flags, Mapping, 'give a dictionary of booleans, such as {"gravity": False}')
    for name, enabled in flags.items():
        if name not in bits:
            raise ValueError(f"MuJoCo has no flag {name!r}: known are {', '.join(sorted(bits))}")
        check_instance(f"the flag {name!r}", enabled, (bool, np.bool_), "give True to enable it, or False")
        field, bit, is_set = bits[name]
        others = getattr(mj.opt, field) & ~bit
        setattr(mj.opt, field, others | bit if bool(enabled) == is_set else others)


__all__ = ["Overrides", "check_options", "may_touch", "moving_geoms", "with_overrides", "without_idle_parts"]
