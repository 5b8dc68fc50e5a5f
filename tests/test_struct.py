"""The pytree dataclass."""

import jax
import pytest

from rewax import struct


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
