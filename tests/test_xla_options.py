"""Options of XLA: the pair that gives wrong gradients is found, and none of ours makes it."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax import xla_options
from rewax.cli.doctor import flag_problems
from rewax.xla_options import warn_of_wrong_gradients, wrong_gradients

OLDER, UNOPTIMISED = "--xla_cpu_use_fusion_emitters=false", "--xla_backend_optimization_level=0"


@pytest.mark.parametrize("flags", [f"{OLDER} {UNOPTIMISED}", f"{UNOPTIMISED}  --xla_dump_to=x {OLDER}"])
def test_two_flags_that_give_zero_gradients_cause_a_warning(flags, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", flags)
    with pytest.warns(
        UserWarning, match=r"^XLA_FLAGS: .*=false together with .*=0 gives .* zero: remove one of the two$"
    ):
        warn_of_wrong_gradients()
    ((problem, remedy),) = flag_problems(flags)
    assert problem == wrong_gradients(flags) and "XLA_FLAGS" in remedy


@pytest.mark.parametrize(
    "flags", ["", OLDER, UNOPTIMISED, f"{OLDER} {UNOPTIMISED[:-1]}3", f"{OLDER[:-5]}true {UNOPTIMISED}"]
)
def test_either_flag_alone_is_right(flags, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", flags)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_wrong_gradients()
    assert not list(flag_problems(flags))


def test_options_of_ours_are_never_that_pair():
    for options in (xla_options.QUICK, xla_options.QUICK_IN_XLA, xla_options.unoptimised()):
        flags = " ".join(f"--{name}={value}" for name, value in options.items())
        assert wrong_gradients(flags) is None
        if xla_options.knows(**options):
            slope = jax.jit(jax.grad(lambda x: jnp.sum(jnp.sin(x))), compiler_options=options)(jnp.arange(3.0))
            np.testing.assert_allclose(slope, np.cos(np.arange(3.0)), rtol=1e-6)
    assert xla_options.knows(**xla_options.unoptimised())
    assert not xla_options.knows(xla_cpu_no_such_option=True)


def test_unoptimised_programs_leave_the_older_generator():
    """Else ``XLA_FLAGS`` that select it would complete the pair."""
    chosen = xla_options.unoptimised().get("xla_cpu_use_fusion_emitters")
    assert chosen is (True if xla_options.has_older_generator() else None)
