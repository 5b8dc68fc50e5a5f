"""The kernels in C++ give the numbers of those in JAX, alone and in a substep."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER
from transfer_cases import NUM, assert_as_transfer_cpu, assert_substep_agrees, inputs, locations, program, run

from rewax.lowering import build
from rewax.physics.mpm import transfer_cpp, transfer_xla_cpu
from rewax.physics.mpm.grid import Grid

KERNELS = ("scatter", "gather_values", "scatter_tangent_transpose", "gather_tangent_transpose")
pytestmark = NEEDS_COMPILER


def test_a_compiler_that_is_there_builds_them():
    """Else all other tests would compare transfer_xla_cpu with itself."""
    assert transfer_cpp.is_used(), build.load(transfer_cpp.SOURCE).reason


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("batch", [pytest.param((), marks=pytest.mark.slow), (2,)])
def test_the_kernels_agree(x64, batch, listed):
    assert_as_transfer_cpu(transfer_cpp, KERNELS, batch, listed)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sums_of_many_particles(x64, dtype):
    """Several pieces and chunks, shared out among threads; a number of particles that no block divides."""
    num, grid = 2 * 4096 + 1029, Grid(shape=(12, 11, 13), spacing=0.1)
    draw = np.random.default_rng(2)
    where = tuple(jnp.asarray(draw.uniform(0.06, 0.1 * (n - 1.6), num), dtype) for n in grid.shape)
    layout = transfer_xla_cpu.Layout(grid, None)
    for name in KERNELS:
        given = inputs(name, where, (), grid.num_nodes, num, dtype)[0]
        kernel = program(transfer_cpp, name, layout, given).compile()
        found, again, expected = kernel(*given), kernel(*given), run(transfer_xla_cpu, name, layout, given)
        for a, b, c in zip(found, again, expected, strict=True):
            assert a.dtype == dtype
            np.testing.assert_array_equal(a, b)
            scale = np.abs(c).max()
            np.testing.assert_allclose(a, c, atol=scale * 200 * np.finfo(dtype).eps, rtol=0, err_msg=name)


def test_environments_are_their_own(x64):
    """One alone has the bits that it has beside others, of which one is not finite and one is outside of the box."""
    layout, where = locations((4,), True)
    x = where[0].at[1].set(jnp.nan).at[2].set(1e30)
    where = (x, *where[1:])
    for name in KERNELS:
        residuals, linear = inputs(name, where, (4,), layout.num_nodes, NUM)[0]
        together = run(transfer_cpp, name, layout, (residuals, linear))
        each = [jax.tree.map(lambda a, i=i: a[i], (residuals, linear)) for i in (0, 3)]
        kernel = program(transfer_cpp, name, layout, each[0]).compile()
        for i, given in zip((0, 3), each, strict=True):
            for a, b in zip(together, kernel(*given), strict=True):
                assert np.isfinite(b).all()
                np.testing.assert_array_equal(a[i], b)
        assert np.isnan(together[0][1]).any()


@pytest.fixture
def without_a_compiler(monkeypatch):
    """Programs traced under it hold what they would hold on a CPU without a compiler."""
    jax.clear_caches()
    monkeypatch.setattr(transfer_cpp, "is_used", lambda: False)
    yield
    monkeypatch.undo()
    jax.clear_caches()


def test_a_substep_and_its_derivatives_agree_without_a_compiler(x64, request):
    assert_substep_agrees(request, "without_a_compiler")
