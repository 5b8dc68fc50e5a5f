"""Checks of numbers: both sides of each limit, arrays, words, and traced values, which are flagged instead."""

import enum

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax import struct
from rewax.physics.numerics.checks import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    Legal,
    Number,
    any_illegal,
    check_enum,
    check_number,
    check_numbers,
    friction_dampings,
    numbers_of,
    static_integer,
    static_number,
)

SHARE = Legal(0.0, 1.0)
LEGAL = [
    (0.5, SHARE), (np.array([0.1, 0.9]), SHARE), (1e-30, POSITIVE), (3, POSITIVE), (0.0, NOT_NEGATIVE),
    (np.float32(0.0), NOT_NEGATIVE), (jnp.zeros(2), NOT_NEGATIVE), (-0.0, NOT_NEGATIVE), (-1e9, FINITE),
]  # fmt: skip
ILLEGAL = [
    (0.0, SHARE, " is 0.0, but must be above 0 and below 1"),
    (1.0, SHARE, " is 1.0, but must be above 0 and below 1"),
    (np.nan, SHARE, " is nan, but must be above 0 and below 1 and finite"),
    (np.array([[0.5, 2.0]]), SHARE, "[0, 1] is 2.0, but must be above 0 and below 1"),
    (0.0, POSITIVE, " is 0.0, but must be positive"),
    (np.inf, POSITIVE, " is inf, but must be positive and finite"),
    (-1e-30, NOT_NEGATIVE, " is -1e-30, but must be 0 or more"),
    (np.array([1, -2]), NOT_NEGATIVE, "[1] is -2, but must be 0 or more"),
    (-np.inf, FINITE, " is -inf, but must be finite"),
]


@pytest.mark.parametrize(("value", "legal"), LEGAL)
def test_legal_numbers_pass_known_and_traced(value, legal):
    check_number("share", value, legal, "give a share")
    flag = jax.jit(lambda v: any_illegal([Number("share", v, legal, "")]))
    assert not flag(value) and not any_illegal([Number("share", value, legal, "")])


@pytest.mark.parametrize(("value", "legal", "sentence"), ILLEGAL)
def test_illegal_numbers_are_refused_known_and_flagged_traced(value, legal, sentence):
    with pytest.raises(ValueError) as caught:
        check_number("share", value, legal, "give a share")
    assert str(caught.value) == f"share{sentence}: give a share"
    assert any_illegal([Number("other", 0.5, SHARE, ""), Number("share", value, legal, "")])

    @jax.jit
    def flag(value):
        check_number("share", value, legal, "give a share")
        return any_illegal([Number("other", 0.5, SHARE, ""), Number("share", value, legal, "")])

    assert flag(value)


def test_long_arrays_and_several_of_a_kind_are_flagged():
    def flag(*values):
        return any_illegal(Number("a", v, POSITIVE, "") for v in values)

    long, short = jnp.ones(5000), jnp.ones((2, 3))
    assert not jax.jit(flag)(long, short, short, None)
    assert jax.jit(flag)(long.at[4321].set(0.0), short, short)
    assert jax.jit(flag)(long, short, short.at[1, 2].set(jnp.nan))
    np.testing.assert_array_equal(jax.vmap(lambda a: flag(short, a))(jnp.array([1.0, -1.0, 2.0])), [False, True, False])


@pytest.mark.parametrize("value", ["fast", [[1.0], [2.0, 3.0]], 1j, object, True, np.array([True, False]), [], ()])
def test_what_is_no_number_is_refused(value):
    with pytest.raises(ValueError, match=r"^share is .*, which is no real number: give a share$"):
        check_number("share", value, SHARE, "give a share")


@pytest.mark.parametrize(
    ("damping", "frictions", "illegal"),
    [
        (0.0, (0.0, 0.0), False),
        (0.1, (0.0, 0.5), False),
        (0.0, (0.0, 0.5), True),
        (np.array([0.0, 0.1]), (np.array([0.0, 0.5]),), False),
        (np.array([0.0, 0.1]), (0.5,), False),  # one of the vertices slides freely
        (np.array([0.0, 0.1]), (np.array([0.5, 0.0]),), True),
        (np.zeros(2), (0.5,), True),
        (0.0, (np.array([0.0, 0.5]), 0.0), True),
    ],
)
def test_friction_needs_its_damping_where_something_rubs(damping, frictions, illegal):
    numbers = friction_dampings("contact.friction_damping", damping, *frictions)
    assert bool(any_illegal(numbers)) == illegal
    assert bool(jax.jit(lambda d, *f: any_illegal(friction_dampings("", d, *f)))(damping, *frictions)) == illegal
    if illegal:
        with pytest.raises(ValueError, match=r"friction_damping with friction.* must be positive.*a friction of 0"):
            check_numbers(numbers)


def test_friction_of_another_form_is_left_to_other_checks():
    assert friction_dampings("d", "words", 0.5) == [] and friction_dampings("d", np.zeros(3), np.ones(2)) == []


def test_a_missing_number_is_refused():
    with pytest.raises(ValueError, match=r"^share is None, but must be positive: give a share$"):
        check_number("share", None, POSITIVE, "give a share")


def test_shapes_are_known_of_traced_numbers_too():
    def build(a):
        check_numbers([Number("place", a, FINITE, "", (3,)), Number("place", (a[0], 0.0, 0.0), FINITE, "", (3,))])
        return a

    jax.jit(build)(jnp.ones(3))
    with pytest.raises(ValueError, match=r"^place has shape \(2,\): give an array of shape \(3,\)"):
        jax.jit(build)(jnp.ones(2))


def test_traced_numbers_that_are_no_array_are_refused():
    def check(w):
        check_number("weights", (w, (1.0, 2.0)), FINITE, "give three numbers")
        return w

    with pytest.raises(ValueError, match=r"^weights is \(.*, which is no array: give three numbers"):
        jax.grad(check)(0.5)


def test_static_numbers_and_counts():
    assert static_number("dt", jnp.float32(0.5), POSITIVE, "") == 0.5
    with pytest.raises(ValueError, match=r"^dt is traced, but is part of the compiled program"):
        jax.jit(lambda dt: static_number("dt", dt, POSITIVE, ""))(0.5)
    with pytest.raises(ValueError, match=r"^dt has shape \(1,\): give one number$"):
        static_number("dt", [0.5], POSITIVE, "")
    assert static_integer("n", np.int32(3), 3, "") == 3 and static_integer("n", 3.0, 1, "") == 3
    for bad in (2, 3.5, "three", None, np.nan, np.inf, True, 10**30):
        with pytest.raises(ValueError, match=r"^n is .*: give 3 or more$"):
            static_integer("n", bad, 3, "give 3 or more")


def test_members_are_listed():
    kind = enum.Enum("Kind", ["SOFT", "HARD"])
    check_enum("kind", kind.SOFT, kind)
    with pytest.raises(ValueError, match=r"^kind is 'soft': give one of Kind\.SOFT, Kind\.HARD$"):
        check_enum("kind", "soft", kind)


@struct.dataclass
class Spring:
    stiffness: object = struct.number(POSITIVE, "give it in N/m")
    anchor: object = struct.number(FINITE, "give a position", shape=(3,), default=(0.0, 0.0, 0.0))
    damping: object = struct.number(NOT_NEGATIVE, "give it in N s/m", default=None)
    name: str = struct.static_field(default="spring")


def test_numbers_of_an_object_are_those_that_its_fields_declare():
    found = numbers_of(Spring(stiffness=2.0), "left.")
    assert [(n.name, n.legal, n.shape) for n in found] == [
        ("left.stiffness", POSITIVE, None), ("left.anchor", FINITE, (3,)),
    ]  # fmt: skip
    assert [n.name for n in numbers_of(Spring(stiffness=2.0, damping=0.0))] == ["stiffness", "anchor", "damping"]
    check_numbers(found)
    for broken, sentence in {
        "stiffness is None, but must be positive: give it in N/m": {"stiffness": None},
        "damping is -1.0, but must be 0 or more: give it in N s/m": {"stiffness": 1.0, "damping": -1},
        r"anchor has shape \(2,\): give an array of shape \(3,\)": {"stiffness": 1.0, "anchor": (1, 2)},
    }.items():
        with pytest.raises(ValueError, match=f"^{broken}$"):
            check_numbers(numbers_of(Spring(**sentence)))
