"""Bad scenes and bad MJCF, drawn with a seed, for ``input_fuzzer``: one argument of a good scene, or one place in a good
model, is replaced by something that cannot be."""

import random
import re
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rewax.physics import mpm, rigid, tets, thin
from rewax.physics.contact import Collider, Ground, PenaltyContact
from rewax.physics.mpm import Grid, Hencky, Material, VonMises, Wall, Walls
from rewax.physics.rigid import Penalty
from rewax.physics.shapes import Box, Capsule, Sphere
from rewax.physics.tets import tetmesh

nan, inf = float("nan"), float("inf")


class Call(NamedTuple):
    """A function and its arguments, which may be calls, or tuples of calls, themselves."""

    function: Callable[..., Any]
    arguments: dict[str, Any]


class Number(NamedTuple):
    """A number of a good scene, and whether it may be negative; or a vector of such numbers."""

    value: Any
    signed: bool = False


def call(function: Callable[..., Any], **arguments: Any) -> Call:
    return Call(function, arguments)


def _collider(shape: Call) -> Call:
    return call(
        Collider, shape=shape, friction=Number(0.5), softness=Number(100.0), offset=Number((0.0, 0.1, 0.0), signed=True)
    )


_COLLIDERS = (
    _collider(call(Sphere, radius=Number(0.1))),
    _collider(call(Box, half_size=Number((0.1, 0.2, 0.1)))),
    _collider(call(Capsule, radius=Number(0.1), half_length=Number(0.1))),
)
_CONTACT = {
    "contact": call(PenaltyContact, stiffness=Number(1e3), damping=Number(1.0), friction_damping=Number(1.0)),
    "ground": call(Ground, normal=Number((0.0, 1.0, 0.0), signed=True), height=Number(0.0, signed=True)),
    "gravity": Number((0.0, -9.81, 0.0), signed=True),
    "colliders": _COLLIDERS,
}
SCENES = {
    "mpm": call(
        mpm.make_scene,
        grid=call(Grid, shape=Number((8, 9, 10)), spacing=Number(0.1), origin=Number((0.0, -0.2, 0.0), signed=True)),
        dt=Number(1e-4),
        material=call(
            Material,
            density=Number(1000.0),
            elasticity=call(Hencky, youngs_modulus=Number(1e4), poissons_ratio=Number(0.3, signed=True)),
            plasticity=call(VonMises, yield_stress=Number(50.0)),
        ),
        particle_volume=Number(1e-4),
        gravity=Number((0.0, -9.81, 0.0), signed=True),
        colliders=_COLLIDERS,
        walls=call(
            Walls,
            lower=(None, call(Wall, position=Number(0.1, signed=True), friction=Number(0.4)), None),
            upper=(None, None, None),
        ),
        max_active_nodes=Number(500),
        reach=Number(1.0),
    ),
    "tets": call(
        tets.make_scene,
        mesh=call(tetmesh.box, counts=Number((1, 1, 1)), size=Number((0.1, 0.1, 0.1))),
        density=Number(1000.0), mu=Number(1e4), lam=Number(2e4), dt=Number(1e-5), damping=Number(1.0), **_CONTACT,
    ),
    "thin": call(
        thin.make_scene,
        mesh=call(thin.sheet, width=Number(0.2), length=Number(0.2), num_x=Number(2), num_z=Number(2)),
        cloth=call(
            thin.isotropic_cloth,
            youngs_modulus=Number(1e4), poissons_ratio=Number(0.3, signed=True), thickness=Number(1e-3), density=Number(200.0),
        ),
        dt=Number(1e-5), drag=Number(0.1), **_CONTACT,
    ),
}  # fmt: skip

MODEL = """<mujoco><compiler autolimits="true"/><option timestep="0.002" gravity="0 0 -9.81"/><default><geom friction="0.8 0.01 0.01"/></default>
<worldbody><geom name="floor" type="plane" size="1 1 1"/><body name="arm" pos="0 0 1"><joint name="swing" type="hinge" axis="0 1 0" range="-1 1"/>
<geom name="rod" type="capsule" size="0.05 0.2" mass="1"/><body name="hand" pos="0 0 0.3"><joint name="wrist" type="slide" axis="1 0 0"/>
<geom name="ball" type="sphere" size="0.05" density="500"/></body></body></worldbody>
<actuator><motor name="pull" joint="swing" gear="3"/><position name="hold" joint="wrist" kp="20"/></actuator></mujoco>"""
_NUMBERS = ("timestep", "gravity", "friction", "pos", "axis", "range", "size", "mass", "density", "gear", "kp")
"""Attributes of the model that hold numbers."""
_POSITIVE = ("size", "mass", "density", "timestep")
RIGID = {
    "dt": Number(1e-3),
    "penalty": call(
        Penalty, stiffness=Number(1e4), damping=Number(10.0), friction_damping=Number(1.0), onset=Number(0.01),
        limit_stiffness=Number(1e3), limit_damping=Number(10.0),
    ),
    "integrator": "Euler", "cone": "pyramidal",
}  # fmt: skip


def build(tree: Any) -> Any:
    """The value of a tree of calls."""
    if isinstance(tree, Call):
        return tree.function(**{name: build(each) for name, each in tree.arguments.items()})
    if isinstance(tree, Number):
        return tree.value
    return tuple(map(build, tree)) if type(tree) is tuple else tree


def bad_scenes(rng: random.Random) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Names of arguments with values that cannot be, and functions that build the scene with them."""
    while True:
        kind = rng.choice(list(SCENES))
        tree, where, wrong = _spoiled(rng, SCENES[kind])
        yield f"{kind}.make_scene: {where} = {wrong!r}"[:160], lambda tree=tree: build(tree)


def bad_models(rng: random.Random) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Texts of MJCF and options of ``rigid.load`` that cannot be, and functions that load them."""
    while True:
        if rng.random() < 0.3:
            tree, where, wrong = _spoiled(rng, call(rigid.load, source=MODEL, **RIGID))
            yield f"rigid.load: {where} = {wrong!r}"[:160], lambda tree=tree: build(tree)
            continue
        text, what = _spoiled_text(rng)
        yield f"MJCF: {what}", lambda text=text: rigid.load(text)


def _spoiled(rng: random.Random, tree: Any, where: str = "") -> tuple[Any, str, Any]:
    """A tree with one wrong value, the path of this value, and the value."""
    if isinstance(tree, Call):
        name = rng.choice([name for name, each in tree.arguments.items() if each is not None and each != MODEL])
        each, path, wrong = _spoiled(rng, tree.arguments[name], f"{where}.{name}".lstrip("."))
        return Call(tree.function, {**tree.arguments, name: each}), path, wrong
    given = [i for i, each in enumerate(tree) if each is not None] if type(tree) is tuple else []
    if given and rng.random() < 0.9:
        i = rng.choice(given)
        each, path, wrong = _spoiled(rng, tree[i], f"{where}[{i}]")
        return (*tree[:i], each, *tree[i + 1 :]), path, wrong
    wrong = rng.choice(_wrong_values(tree))
    return wrong, where, wrong


def _wrong_values(good: Any) -> list[Any]:
    """Values that no scene takes in the place of a good one."""
    wrong: list[Any] = [
        object(),
        "abc",
        {},
        {"a": 1},
        b"x",
        1 + 2j,
        [[]],
        ["a"],
        {1},
        ("a", "b", "c"),
        np.full((2, 5), 1.0),
    ]
    if not isinstance(good, Number):
        return [*wrong, 3.5, True, -1]
    numbers = [nan, inf, -inf, *([] if good.signed else [-1.0, -1e-9])]
    if isinstance(good.value, tuple):
        vectors = [(*good.value[:2], number) for number in numbers]
        return [*wrong, *vectors, good.value[:2], (*good.value, 1.0), nan]
    return [*wrong, *numbers, (1.0, nan)]


def _spoiled_text(rng: random.Random) -> tuple[str, str]:
    """A text that is no model, and what was done to it."""
    kind = rng.randrange(6)
    if kind == 0:
        end = rng.randrange(1, len(MODEL) - 9)
        return MODEL[:end], f"cut off after {end} characters"
    if kind == 1:
        name = rng.choice(sorted(set(re.findall(r" ([a-z]+)=", MODEL))))
        return MODEL.replace(f" {name}=", f" {name}x="), f"attribute {name}x"
    if kind == 2:
        tag = rng.choice(sorted(set(re.findall(r"<([a-z]+)[ />]", MODEL))))
        return re.sub(rf"(</?){tag}\b", rf"\1{tag}x", MODEL), f"element {tag}x"
    if kind == 3:
        name = rng.choice(("swing", "wrist"))
        return MODEL.replace(f'joint="{name}"', 'joint="nothing"'), f"a motor of no joint instead of {name}"
    name = rng.choice(_NUMBERS if kind == 4 else _POSITIVE)  # MuJoCo reads an empty text as an absent attribute
    wrong = rng.choice(("abc", "1,2", "nan", "inf") if kind == 4 else ("-1", "0", "-0.001"))
    if name in ("mass", "density") and wrong == "0":
        wrong = "-2"  # a geom without mass is legal
    return re.sub(rf'(<[^>]*?\b{name}=)"[^"]*"', rf'\1"{wrong}"', MODEL), f'{name}="{wrong}"'


__all__ = ["bad_models", "bad_scenes"]
