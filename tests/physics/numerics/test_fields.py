"""Rules for arguments: legal values pass, and a message names argument, value and remedy."""

import enum
import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.numerics import Pose, static_poses
from rewax.physics.numerics.checks import FINITE, POSITIVE, shown
from rewax.physics.numerics.fields import (
    check_fields,
    check_range,
    checked,
    indices,
    instance,
    integer,
    items,
    key,
    mask,
    member,
    one_of,
    optional,
    poses,
    real,
    static,
)


class Kind(enum.Enum):
    SOFT = "soft"


LENGTH = real(POSITIVE, "give a length")
RULES = {
    "real": (LENGTH, (1.0, np.float32(2), jnp.float32(1), 3), (0.0, "a", None, True, [1.0], [], 1j, np.nan)),
    "points": (real(FINITE, "give points", ("n", 3)), (np.ones((2, 3)), [[0, 1, 2]]), (np.ones(3), [[1, 2]], "a")),
    "static": (static(POSITIVE, "give dt"), (1.0, np.float64(2)), (-1.0, [1.0, 2.0], "a", None)),
    "integer": (integer(2, "give 2 or more"), (2, np.int64(5), jnp.int32(3)), (1, 2.0, True, "2", None, [2], 10**30)),
    "member": (member(Kind), (Kind.SOFT,), ("soft", None, 1)),
    "instance": (instance(dict, "give a dict"), ({},), ([], None, dict)),
    "optional": (optional(LENGTH), (None, 1.0), (0.0, "a")),
    "items": (items(LENGTH, "give two", length=2), ((1.0, 2.0), [1, 2], np.ones(2)), ((1.0,), None, "ab", 1.0, (1.0, 0.0))),
    "indices": (indices("give pairs", ("n", 2)), ([[0, 1]], np.zeros((3, 2), int)), ([0, 1], [[0.0, 1.0]], None, [[0], []])),
    "mask": (mask("give a mask", ("n",)), ([True, False], np.ones(3)), (True, [0.5], "a", None, [[True]])),
    "one_of": (one_of(5, 6), (5, 6.0), (7, True, None, "5", [5], np.ones(2))),
    "poses": (poses("num_bodies"), (Pose(jnp.zeros((2, 3)), jnp.zeros((2, 3, 3))),), (static_poses(1), None, jnp.zeros(3))),
    "key": (key, (jax.random.key(0), jax.random.PRNGKey(0)), (0, None, "a", jnp.zeros(2))),
}  # fmt: skip


@pytest.mark.parametrize(("rule", "legal", "illegal"), RULES.values(), ids=RULES)
def test_rules_accept_legal_values_and_name_illegal_ones(rule, legal, illegal):
    for value in legal:
        rule("name", value)
    for value in illegal:
        with pytest.raises(ValueError, match=r"^name(\[[0-9, ]+\])? (is|has) .*: give ") as caught:
            rule("name", value)
        assert "\n" not in str(caught.value)


def test_items_are_named_by_their_index():
    with pytest.raises(ValueError, match=r"^sizes\[1\] is -2\.0, but must be positive: give a length$"):
        items(LENGTH, "give sizes")("sizes", (1.0, -2.0))


def test_traced_values_are_checked_for_their_shape_only():
    rule = real(POSITIVE, "give points", ("n", 3))
    jax.jit(lambda x: rule("x", x))(-jnp.ones((2, 3)))
    with pytest.raises(ValueError, match=r"^x has shape \(3,\): give an array of shape \(n, 3\)"):
        jax.jit(lambda x: rule("x", x))(jnp.ones(3))
    with pytest.raises(ValueError, match=r"^x has shape \(2,\): give one number"):
        jax.jit(lambda x: LENGTH("x", x))(jnp.ones(2))


@checked(radius=LENGTH, num=integer(1, "give at least 1"))
def points(radius, num=3, *, scale=None):
    """Docstring."""
    return radius, num, scale


def test_checked_functions_keep_their_signature_and_name_what_is_wrong():
    assert points(2.0) == (2.0, 3, None) and points(1.0, scale="x", num=5) == (1.0, 5, "x")
    assert points.__name__ == "points" and points.__doc__ == "Docstring."
    assert list(inspect.signature(points).parameters) == ["radius", "num", "scale"]
    with pytest.raises(ValueError, match=r"^radius is -1\.0, but must be positive: give a length$"):
        points(-1.0)
    with pytest.raises(ValueError, match=r"^num is 0: give at least 1$"):
        points(1.0, num=0)
    with pytest.raises(TypeError, match="missing"):
        points()


def test_names_have_a_prefix_and_absent_fields_pass():
    check_fields({"radius": LENGTH, "other": LENGTH}, {"radius": 1.0}, "Ball.")
    with pytest.raises(ValueError, match=r"^Ball\.radius is 0\.0, but"):
        check_fields({"radius": LENGTH}, {"radius": 0.0}, "Ball.")


def test_indices_must_be_in_range():
    check_range("tets", np.array([[0, 3]]), 4)
    check_range("tets", np.zeros((0, 4), int), 4)
    for bad in ([-1, 2], [0, 4]):
        with pytest.raises(
            ValueError, match=r"^tets has indices from .* but there are 4 vertices: give indices from 0 to 3$"
        ):
            check_range("tets", np.array(bad), 4)


def test_values_are_shown_on_one_short_line():
    assert shown(np.ones((3, 3))) == "an array of float64 of shape (3, 3)" and shown(np.ones(2)) == "array([1., 1.])"
    assert shown("a") == "'a'" and len(shown(list(range(1000)))) == 100
    assert re.fullmatch(r"\S.*", shown(type("Odd", (), {"__repr__": lambda self: "two\n  lines"})()))
