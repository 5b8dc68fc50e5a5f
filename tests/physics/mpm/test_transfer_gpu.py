"""The passes for GPUs give the numbers of those for CPUs, alone and in a substep; evaluated on a CPU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from squeezed_block import one_substep, squeezed

from rewax.physics.mpm import transfer_cpu, transfer_gpu
from rewax.physics.mpm.active_nodes import count_nodes, list_nodes
from rewax.physics.mpm.grid import Grid
from rewax.physics.mpm.materials import Elasticity, Plasticity
from rewax.physics.mpm.walls import Wall, WallKind
from rewax.physics.numerics.linear_pass import ByPlatform

GRID = Grid(shape=(9, 8, 7), spacing=0.1, origin=(-0.1, 0.2, 0.0))
NUM = 20


def places(batch, listed):
    """Layout and places of particles, some of them midway between nodes."""
    draw = np.random.default_rng(0)
    x = [draw.uniform(GRID.origin[a] + 0.15, GRID.origin[a] + 0.45, (*batch, NUM)) for a in range(3)]
    x[0][..., 0] = GRID.origin[0] + 0.25
    if not listed:
        return transfer_cpu.Layout(GRID, None), tuple(jnp.asarray(a) for a in x)
    points = jnp.stack([jnp.asarray(a) for a in x], axis=-1).reshape(-1, NUM, 3)
    count = max(int(count_nodes(GRID, p)) for p in points)
    offset = jnp.stack([list_nodes(GRID, p, count).offset for p in points]).reshape(*batch, -1)
    return transfer_cpu.Layout(GRID, count), (*(jnp.asarray(a) for a in x), offset)


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("batch", [pytest.param((), marks=pytest.mark.slow), (2,)])
def test_the_passes_agree(x64, batch, listed):
    layout, where = places(batch, listed)
    draw = np.random.default_rng(1)

    def arrays(count, length):
        return tuple(jnp.asarray(draw.standard_normal((*batch, length))) for _ in range(count))

    nodes = layout.num_nodes
    cases = {
        "spread": [(where, arrays(13, NUM)), (where, arrays(12, NUM))],
        "gather_values": [(where, arrays(4, nodes)), (where, arrays(3, nodes))],
        "gather_slopes": [((*where, *arrays(3, nodes)), ())],
        "spread_tangent_transpose": [((*where, *arrays(13, NUM)), arrays(4, nodes))],
    }
    for name, given in cases.items():
        for residuals, linear in given:
            of_gpu, of_cpu = (getattr(m, name)(layout, residuals, linear) for m in (transfer_gpu, transfer_cpu))
            assert len(of_gpu) == len(of_cpu) > 0
            for a, b in zip(of_gpu, of_cpu, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-11, err_msg=name)


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    """Programs traced under it hold what they would hold on a GPU."""
    jax.clear_caches()
    monkeypatch.setattr(ByPlatform, "__call__", lambda self, *args: self.other(*args))
    yield
    monkeypatch.undo()
    jax.clear_caches()


def derivatives(args):
    def loss(args):
        state = one_substep(args)
        return sum(jnp.sum(jnp.sin(leaf * (1.0 + i))) for i, leaf in enumerate(jax.tree.leaves(state)))

    return one_substep(args), jax.grad(loss)(args), jax.jvp(loss, (args,), (jax.tree.map(jnp.ones_like, args),))[1]


@pytest.mark.slow
def test_a_substep_and_its_derivatives_agree(x64, request):
    args = squeezed(Elasticity.HENCKY, Plasticity.VON_MISES, "capsule", Wall(position=0.1, kind=WallKind.STICKY))
    expected = jax.jit(derivatives)(args)
    request.getfixturevalue("as_on_a_gpu")
    found = jax.jit(derivatives)(args)
    pairs = list(zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True))
    for a, b in pairs:
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * float(jnp.abs(b).max()))
    assert any((np.asarray(a) != np.asarray(b)).any() for a, b in pairs)  # other programs indeed
