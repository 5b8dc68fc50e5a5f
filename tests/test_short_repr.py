"""Texts of objects that hold arrays are short and say what matters."""

import enum

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewax
from rewax import struct
from rewax.envs import AutoReset, stack
from rewax.envs.randomize import leaves


class Kind(enum.Enum):
    SOFT = "soft"


@struct.dataclass
class Inner:
    size: jax.Array
    label: str = struct.static_field(default="a")


@struct.dataclass
class Outer:
    parts: tuple
    table: dict
    large: jax.Array
    kind: Kind = struct.static_field(default=Kind.SOFT)
    absent: jax.Array | None = None


def test_arrays_are_printed_by_type_and_shape_and_short_ones_by_value():
    inner = Inner(size=(0.25, -1e-7, 3.0))
    outer = Outer(parts=(inner,), table={"n": np.arange(2), "key": jax.random.key(0)}, large=np.zeros((64, 3)))
    kind = jnp.result_type(float).name
    assert repr(inner) == "Inner(size=[0.25, -1e-07, 3], label='a')"
    assert repr(outer) == (
        "Outer(parts=(Inner(size=[0.25, -1e-07, 3], label='a'),), table={'n': [0, 1], 'key': key<fry>[]}, "
        f"large={kind}[64,3], kind=Kind.SOFT)"
    )


def test_long_tuples_and_dicts_are_counted():
    many = tuple(Inner(size=1.0) for _ in range(19))
    text = repr(Outer(parts=many, table={i: i for i in range(40)}, large=jnp.zeros(9)))
    assert text.count("Inner(") == 2 and "... 17 more" in text and "... 34 more" in text


def test_traced_arrays_have_no_values():
    texts = []

    @jax.jit
    def function(inner):
        texts.append(repr(inner))
        return inner.size

    function(Inner(size=1.0))
    assert texts == [f"Inner(size={jnp.result_type(float).name}[], label='a')"]


@pytest.mark.parametrize(
    ("name", "options", "parts"),
    [
        ("RollingFlat", {"youngs_modulus": 400.0}, ["RollingFlat(scale='small', youngs_modulus=400.0, observation={", "'particle_q': (64, 3)", "action=(3,), control_dt=0.007 s, num_substeps=10, episode_length=60, 256 particles, 23 parameters)"]),
        ("SoftJumper", {}, ["204 vertices, 444 tets, 28 parameters)"]),
        ("GripperLift", {}, ["512 particles, 3 dofs, "]),
        ("CartpoleSwingUp", {}, ["observation={'state': (5,)}, action=(1,)", "2 dofs, "]),
    ],
)  # fmt: skip
def test_a_task_is_one_short_line(name, options, parts):
    env = rewax.make(name, scale="small", **options)
    assert all(part in repr(env) for part in parts) and len(repr(env)) < 250
    assert f"{len(leaves(env))} parameters)" in repr(env)


def test_states_scenes_and_wrapped_tasks_are_short_too():
    env = rewax.make("HandFlip", scale="small")
    for tree, most in ((env.scene, 1100), (jax.eval_shape(env.reset, jax.random.key(0)), 700), (env.hand, 400)):
        assert len(repr(tree)) < most and "\n" not in repr(tree)
    assert repr(AutoReset(env=env)) == f"AutoReset(env={env!r})"
    assert "256 particles" in repr(stack([env, env]))


def test_a_tree_of_anything_has_a_text():
    env = rewax.make("RollingFlat", scale="small")
    for leaf in (None, "x", object()):
        assert repr(jax.tree.map(lambda _, leaf=leaf: leaf, env)).startswith("RollingFlat(")
