"""The kernels for GPUs give the numbers of those for CPUs, alone and in a substep; evaluated on a CPU."""

import jax
import pytest
from transfer_cases import assert_as_transfer_cpu, assert_substep_agrees

from rewax.lowering.linear_primitive import ByPlatform
from rewax.physics.mpm import transfer_gpu

KERNELS = (
    "scatter", "gather_values", "gather_slopes", "scatter_tangent_transpose", "gather_tangent", "gather_tangent_transpose",
)  # fmt: skip


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("batch", [pytest.param((), marks=pytest.mark.slow), (2,)])
def test_the_kernels_agree(x64, batch, listed):
    assert_as_transfer_cpu(transfer_gpu, KERNELS, batch, listed)


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    """Programs traced under it hold what they would hold on a GPU."""
    jax.clear_caches()
    monkeypatch.setattr(ByPlatform, "__call__", lambda self, *args: self.other(*args))
    yield
    monkeypatch.undo()
    jax.clear_caches()


@pytest.mark.slow
def test_a_substep_and_its_derivatives_agree(x64, request):
    assert_substep_agrees(request, "as_on_a_gpu")
