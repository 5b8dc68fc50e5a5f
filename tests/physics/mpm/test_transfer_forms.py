"""The three forms of the transfers' passes give the same numbers, alone and in a substep; evaluated on a CPU.

``transfer_cpu`` is the one that the others are compared with.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from squeezed_block import one_substep, squeezed

from rewax.physics.mpm import transfer_cpu, transfer_gpu, transfer_native
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


PASSES = ("spread", "gather_values", "spread_tangent_transpose", "gather_tangent_transpose")
FORMS = {"gpu": (transfer_gpu, (*PASSES, "gather_slopes", "gather_tangent")), "native": (transfer_native, PASSES)}


def inputs(name, where, batch, nodes, num, dtype=float):
    """Residuals and linear arguments of a pass, all that it can be given."""
    draw = np.random.default_rng(1)

    def arrays(count, length):
        return tuple(jnp.asarray(draw.standard_normal((*batch, length)), dtype) for _ in range(count))

    return {
        "spread": [(where, arrays(13, num)), (where, arrays(12, num))],
        "gather_values": [(where, arrays(4, nodes)), (where, arrays(3, nodes))],
        "gather_slopes": [((*where, *arrays(3, nodes)), ())],
        "spread_tangent_transpose": [((*where, *arrays(13, num)), arrays(4, nodes))],
        "gather_tangent": [((*where, *arrays(3, nodes), *arrays(3, num)), (*arrays(3, num), *arrays(3, nodes)))],
        "gather_tangent_transpose": [((*where, *arrays(3, nodes), *arrays(3, num)), arrays(12, num))],
    }[name]


def run(module, name, layout, given):
    return jax.jit(lambda residuals, linear: getattr(module, name)(layout, residuals, linear))(*given)


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("batch", [pytest.param((), marks=pytest.mark.slow), (2,)])
@pytest.mark.parametrize("form", FORMS)
def test_the_passes_agree(x64, form, batch, listed):
    layout, where = places(batch, listed)
    module, names = FORMS[form]
    for name in names:
        for given in inputs(name, where, batch, layout.num_nodes, NUM):
            found, expected = run(module, name, layout, given), run(transfer_cpu, name, layout, given)
            assert len(found) == len(expected) > 0
            for a, b in zip(found, expected, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-11, err_msg=name)
            differ = any((np.asarray(a) != np.asarray(b)).any() for a, b in zip(found, expected, strict=True))
            assert differ, f"{name}: this is the same program"


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_native_sums_of_many_particles(x64, dtype):
    """Several pieces and chunks, shared out among threads; a number of particles that no block divides."""
    num, grid = 2 * 4096 + 1029, Grid(shape=(12, 11, 13), spacing=0.1)
    draw = np.random.default_rng(2)
    where = tuple(jnp.asarray(draw.uniform(0.06, 0.1 * (n - 1.6), num), dtype) for n in grid.shape)
    layout = transfer_cpu.Layout(grid, None)
    for name in PASSES:
        given = inputs(name, where, (), grid.num_nodes, num, dtype)[0]
        found, again, expected = (run(m, name, layout, given) for m in (transfer_native, transfer_native, transfer_cpu))
        for a, b, c in zip(found, again, expected, strict=True):
            assert a.dtype == dtype
            np.testing.assert_array_equal(a, b)
            scale = np.abs(c).max()
            np.testing.assert_allclose(a, c, atol=scale * 200 * np.finfo(dtype).eps, rtol=0, err_msg=name)


def test_native_environments_are_their_own(x64):
    """One alone has the bits that it has beside others, of which one is not finite and one is outside of the box."""
    layout, where = places((4,), True)
    x = where[0].at[1].set(jnp.nan).at[2].set(1e30)
    where = (x, *where[1:])
    for name in PASSES:
        residuals, linear = inputs(name, where, (4,), layout.num_nodes, NUM)[0]
        together = run(transfer_native, name, layout, (residuals, linear))
        for i in (0, 3):
            alone = run(transfer_native, name, layout, jax.tree.map(lambda a, i=i: a[i], (residuals, linear)))
            for a, b in zip(together, alone, strict=True):
                assert np.isfinite(b).all()
                np.testing.assert_array_equal(a[i], b)
        assert np.isnan(together[0][1]).any()


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    """Programs traced under it hold what they would hold on a GPU."""
    jax.clear_caches()
    monkeypatch.setattr(ByPlatform, "__call__", lambda self, *args: self.other(*args))
    yield
    monkeypatch.undo()
    jax.clear_caches()


@pytest.fixture
def without_a_compiler(monkeypatch):
    """Programs traced under it hold what they would hold on a CPU without a compiler."""
    jax.clear_caches()
    monkeypatch.setattr(transfer_native, "is_used", lambda: False)
    yield
    monkeypatch.undo()
    jax.clear_caches()


def derivatives(args):
    def loss(args):
        state = one_substep(args)
        return sum(jnp.sum(jnp.sin(leaf * (1.0 + i))) for i, leaf in enumerate(jax.tree.leaves(state)))

    return one_substep(args), jax.grad(loss)(args), jax.jvp(loss, (args,), (jax.tree.map(jnp.ones_like, args),))[1]


@pytest.mark.parametrize("elsewhere", ["without_a_compiler", pytest.param("as_on_a_gpu", marks=pytest.mark.slow)])
def test_a_substep_and_its_derivatives_agree(x64, request, elsewhere):
    args = squeezed(Elasticity.HENCKY, Plasticity.VON_MISES, "capsule", Wall(position=0.1, kind=WallKind.STICKY))
    expected = jax.jit(derivatives)(args)
    request.getfixturevalue(elsewhere)
    found = jax.jit(derivatives)(args)
    pairs = list(zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True))
    for a, b in pairs:
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * float(jnp.abs(b).max()))
    assert any((np.asarray(a) != np.asarray(b)).any() for a, b in pairs)  # other programs indeed
