"""The pytree dataclass."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax import struct
from rewax.physics.mpm import Hencky
from rewax.physics.numerics.checks import FINITE, NOT_NEGATIVE, POSITIVE
from rewax.types import Scalar


def make(number: int):
    """One of many classes that differ in nothing but what they do."""

    @struct.dataclass
    class Made:
        size: float
        label: str = struct.static_field(default="a")

        def tag(self) -> float:
            return number * self.size

    return Made


def test_jit_tells_classes_with_the_same_fields_apart():
    """With jax's own registration of dataclasses about every tenth answer is that of another class."""
    answer = jax.jit(lambda made: made.tag())
    classes = [make(number) for number in range(40)]
    assert [float(answer(c(size=1.0))) for c in classes] == list(range(40))
    assert jax.tree.structure(classes[0](size=1.0)) != jax.tree.structure(classes[1](size=1.0))


def test_leaves_structure_and_replacement():
    made = make(1)(size=2.0)
    other = made.replace(label="b")
    assert jax.tree.leaves(made) == [2.0] and other.label == "b" and other.size == 2.0
    assert jax.tree.structure(made) == jax.tree.structure(made.replace(size=3.0))
    assert jax.tree.structure(made) != jax.tree.structure(other)
    assert jax.tree.map(lambda a: 2 * a, made).size == 4.0
    assert jax.tree_util.keystr(jax.tree_util.tree_flatten_with_path(made)[0][0][0]) == ".size"
    with pytest.raises(AttributeError):
        made.size = 1.0


@struct.dataclass
class Ball:
    """Every kind of field."""

    radius: Scalar = struct.number(POSITIVE, "give a length in metres")
    center: jax.Array = struct.number(FINITE, "give a position", shape=(3,), default=(0, 0, 0))
    friction: Scalar | None = struct.number(NOT_NEGATIVE, "give a coefficient", default=None)
    gain: Scalar = 1
    tag: str = "ball"
    faces: np.ndarray | None = None
    steps: int = struct.static_field(default=3)

    def __post_init__(self) -> None:
        assert isinstance(self.gain, jax.Array), "checks see arrays"


def test_tuples_of_numbers_and_traced_numbers_become_leaves():
    w = jnp.float32(0.5)
    for value in ((w, 2, 3), [w, np.float32(2), 3.0], (w, jnp.int32(2), w + 2.5)):
        center = Ball(radius=1.0, center=value).center
        assert center.dtype == jnp.float32
        np.testing.assert_array_equal(center, [0.5, 2.0, 3.0])
    np.testing.assert_array_equal(Ball(radius=((1, w), (w, 2))).radius, [[1.0, 0.5], [0.5, 2.0]])
    slope = jax.jit(jax.grad(lambda w: jnp.sum(Ball(radius=1.0, center=(w, 0.0, w * w)).center)))(0.5)
    assert slope == 2.0
    assert Ball(radius=(1, jnp.int32(2))).radius.dtype == jnp.float32
    for value in ((w, jnp.ones(2)), (w, "big"), (w, jnp.bool_(True))):
        assert Ball(radius=value).radius is value, "checks name the field"


def test_numbers_become_leaves():
    ball = Ball(radius=2)
    assert (ball.radius.dtype, ball.radius.weak_type, ball.gain.dtype) == (jnp.float32, True, jnp.float32)
    assert ball.center.dtype == jnp.float32 and ball.center.shape == (3,)
    assert ball.friction is None and ball.tag == "ball" and ball.steps == 3
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(ball)]
    assert names == [".radius", ".center", ".gain", ".tag"]
    for value in (np.float64(0.5), np.array(0.5), [0.5, 1], ((1, 2), (3, 4.5)), np.array([1, 2])):
        assert isinstance(Ball(radius=value).radius, jax.Array)
        np.testing.assert_array_equal(Ball(radius=value).radius, np.asarray(value, np.float32))
    faces = np.array([[0, 1, 2]])
    assert Ball(radius=1.0, faces=faces).faces is faces, "integers outside of numbers stay what they are"
    assert Ball(radius="big").radius == "big", "checks name the field"
    assert isinstance(ball.replace(radius=3).radius, jax.Array)


def test_arrays_do_not_share_memory_with_numpys():
    """JAX shares that of about every third array with its dtype."""
    given = [np.ones(size, np.float32) for size in (3, 16, 64, 1000) for _ in range(10)]
    kept = [make(1)(size=array) for array in given]
    for array in given:
        array[0] = 5.0
    assert all(float(one.size[0]) == 1.0 for one in kept)


def test_a_bare_number_has_a_derivative():
    slope = jax.grad(lambda ball: ball.radius**2, allow_int=True)(Ball(radius=3, tag=None))
    assert float(slope.radius) == 6.0


def test_rebuilt_trees_are_not_checked():
    rebuilt = jax.tree.map(lambda a: "anything", Ball(radius=1.0))
    assert rebuilt.radius == rebuilt.gain == "anything"


def test_replace_leaf_goes_through_objects_tuples_and_dictionaries():
    @struct.dataclass
    class Scene:
        balls: tuple
        parameters: dict

    scene = Scene(balls=(Ball(radius=1.0), Ball(radius=2.0)), parameters={"mass": jnp.ones(2)})
    assert float(struct.replace_leaf(scene, "balls[1].radius", 5.0).balls[1].radius) == 5.0
    np.testing.assert_array_equal(struct.replace_leaf(scene, "parameters[mass]", jnp.zeros(2)).parameters["mass"], 0.0)
    assert scene.balls[1].radius == 2.0
    for path, sentence in {
        "ball": "Scene has no field 'ball': use one of balls, parameters",
        "balls[2].radius": "tuple has no field '2': use one of 0, 1",
        "balls[0].radius.x": "has no field 'x': it has none",
        "parameters[masses]": "dict has no field 'masses': use one of mass",
    }.items():
        with pytest.raises(ValueError, match=re.escape(sentence)):
            struct.replace_leaf(scene, path, 1.0)


def test_replace_leaf_keeps_shapes():
    @struct.dataclass
    class Scene:
        balls: tuple
        gravity: jax.Array

    scene = Scene(balls=(Ball(radius=1.0),), gravity=(0.0, -9.81, 0.0))
    for path, value, sentence in (
        ("gravity", -9.81, "gravity has shape (3,), but the new value (): give numbers of shape (3,)"),
        ("gravity", jnp.ones((3, 2)), "gravity has shape (3,), but the new value (3, 2): give numbers of shape (3,)"),
        ("balls[0].radius", jnp.ones((2, 1)), "balls[0].radius has shape (), but the new value (2, 1)"),
        ("balls[0].radius", "abc", "balls[0].radius is 'abc': give a number or an array of shape ()"),
    ):
        with pytest.raises(ValueError, match=f"^{re.escape(sentence)}"):
            struct.replace_leaf(scene, path, value)
    assert struct.replace_leaf(scene, "gravity", (0, -1, 0)).gravity[1] == -1.0
    assert struct.replace_leaf(scene, "gravity", jnp.ones((4, 3))).gravity.shape == (4, 3)  # four environments
    assert jax.grad(lambda r: struct.replace_leaf(scene, "balls[0].radius", r).balls[0].radius)(2.0) == 1.0
    each = struct.replace_leaf(Hencky(youngs_modulus=1.0, poissons_ratio=0.3), "youngs_modulus", jnp.ones(5))
    assert struct.replace_leaf(each, "youngs_modulus", 2.0).youngs_modulus == 2.0  # one number for all particles again
