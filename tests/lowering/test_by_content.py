"""Objects of equal content are equal, and others are not."""

import numpy as np
import pytest

from rewax.lowering.by_content import ByContent
from rewax.lowering.stencils import Stencil
from rewax.physics.tets.edges import TetTopology


class Other(ByContent):
    pass


def test_equal_contents_of_one_class_are_equal():
    assert ByContent(1, b"a") == ByContent(1, b"a") and hash(ByContent(1, b"a")) == hash(ByContent(1, b"a"))
    assert ByContent(1, b"a") != ByContent(1, b"b") and ByContent(1) != Other(1) and ByContent(1) != 1


@pytest.mark.parametrize("kind", [Stencil, TetTopology])
def test_tables_of_vertices_are_their_numbers(kind):
    table = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
    assert kind(table, 5) == kind(table.copy(), 5) != kind(table[:, ::-1], 5)
    assert kind(table, 5) != kind(table, 6) and len({kind(table, 5), kind(table, 5)}) == 1
