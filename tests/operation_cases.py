"""What lists of operations give, by NumPy."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.lowering.from_jaxpr import from_jaxpr

PYTHON = {
    "neg": np.negative,
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "max": np.maximum, "min": np.minimum, "sqrt": np.sqrt, "gt": np.greater,
    "b_to_f": np.float64, "i_to_f": np.float64, "lt": np.less, "ne": np.not_equal, "eq": np.equal, "div": np.divide,
    "or": np.logical_or, "and": np.logical_and, "select": lambda which, yes, no: yes if which else no,
}  # fmt: skip


def evaluated(program, *args):
    """What the operations give, one after the other."""
    line = from_jaxpr(jax.make_jaxpr(program)(*args), [True] * len(args))
    values = []
    for operation in line.operations:
        if operation.name == "input":
            argument, place = operation.constant
            values.append(np.ravel(args[argument])[place])
        elif operation.name == "constant":
            values.append({"f": float, "i": int, "b": lambda text: text == "True"}[operation.kind](operation.constant))
        else:
            values.append(PYTHON[operation.name](*(values[o] for o in operation.operands)))
    return [[values[i] for i in output] for output in line.outputs]


def assert_equal_to_jax(program, seed: int) -> None:
    """Of two vectors of three numbers."""
    draw = np.random.default_rng(seed)
    a, b = (draw.normal(size=3).astype(np.float32) for _ in range(2))
    expected = jax.tree.leaves(program(*map(jnp.asarray, (a, b))))
    for found, right in zip(evaluated(program, a, b), expected, strict=True):
        np.testing.assert_allclose(found, np.ravel(right), rtol=2e-6, atol=1e-6)
