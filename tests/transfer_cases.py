"""Inputs of the transfers' kernels, and the comparison of each form of them with ``transfer_xla_cpu``."""

import jax
import jax.numpy as jnp
import numpy as np
from squeezed_block import one_substep, squeezed

from rewax.physics.mpm import Hencky, VonMises, transfer_xla_cpu
from rewax.physics.mpm.active_nodes import count_nodes, list_nodes
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.walls import Wall, WallKind

GRID = Grid(shape=(9, 8, 7), spacing=0.1, origin=(-0.1, 0.2, 0.0))
NUM = 20


def locations(batch, listed):
    """Layout and locations, some of them midway between nodes."""
    draw = np.random.default_rng(0)
    x = [draw.uniform(GRID.origin[a] + 0.15, GRID.origin[a] + 0.45, (*batch, NUM)) for a in range(3)]
    x[0][..., 0] = GRID.origin[0] + 0.25
    if not listed:
        return transfer_xla_cpu.Layout(GRID, None), tuple(jnp.asarray(a) for a in x)
    points = jnp.stack([jnp.asarray(a) for a in x], axis=-1).reshape(-1, NUM, 3)
    count = max(int(count_nodes(GRID, p)) for p in points)
    offset = jnp.stack([list_nodes(GRID, p, count).offset for p in points]).reshape(*batch, -1)
    return transfer_xla_cpu.Layout(GRID, count), (*(jnp.asarray(a) for a in x), offset)


def inputs(name, where, batch, nodes, num=NUM, dtype=float):
    """Residuals and linear arguments of a transfer or of its VJP: all that it can be given."""
    draw = np.random.default_rng(1)

    def arrays(count, length):
        return tuple(jnp.asarray(draw.standard_normal((*batch, length)), dtype) for _ in range(count))

    return {
        "scatter": [(where, arrays(13, num)), (where, arrays(12, num))],
        "gather_values": [(where, arrays(4, nodes)), (where, arrays(3, nodes))],
        "gather_slopes": [((*where, *arrays(3, nodes)), ())],
        "scatter_tangent_transpose": [((*where, *arrays(13, num)), arrays(4, nodes))],
        "gather_tangent": [((*where, *arrays(3, nodes), *arrays(3, num)), (*arrays(3, num), *arrays(3, nodes)))],
        "gather_tangent_transpose": [((*where, *arrays(3, nodes), *arrays(3, num)), arrays(12, num))],
    }[name]


def program(module, name, layout, given):
    return jax.jit(lambda residuals, linear: getattr(module, name)(layout, residuals, linear)).lower(*given)


def run(module, name, layout, given):
    return program(module, name, layout, given).compile()(*given)


def assert_as_transfer_cpu(module, names, batch, listed):
    """All kernels of these names agree with ``transfer_xla_cpu``'s, and are other programs."""
    layout, where = locations(batch, listed)
    for name in names:
        for given in inputs(name, where, batch, layout.num_nodes):
            this, other = program(module, name, layout, given), program(transfer_xla_cpu, name, layout, given)
            assert this.as_text() != other.as_text(), f"{name}: this is the same program"
            found, expected = this.compile()(*given), other.compile()(*given)
            assert len(found) == len(expected) > 0
            for a, b in zip(found, expected, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-11, err_msg=name)


def assert_substep_agrees(request, fixture):
    """A substep and its derivatives agree with those under a fixture that chooses another form."""
    args = squeezed(Hencky, VonMises, "capsule", Wall(position=0.1, kind=WallKind.STICKY))
    expected = jax.jit(_derivatives)(args)
    request.getfixturevalue(fixture)
    found = jax.jit(_derivatives)(args)
    pairs = list(zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True))
    for a, b in pairs:
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * float(jnp.abs(b).max()))
    assert any((np.asarray(a) != np.asarray(b)).any() for a, b in pairs)  # other programs indeed


def _derivatives(args):
    def loss(args):
        state = one_substep(args)
        return sum(jnp.sum(jnp.sin(leaf * (1.0 + i))) for i, leaf in enumerate(jax.tree.leaves(state)))

    return one_substep(args), jax.grad(loss)(args), jax.jvp(loss, (args,), (jax.tree.map(jnp.ones_like, args),))[1]
