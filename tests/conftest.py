"""Shared by all tests: programs that compile fast and stay in a cache, few but repeatable hypothesis examples, float64."""

import ctypes
import functools
import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.envs.leaves import strongly_typed
from rewax.xla_options import unoptimised

_QUICK_TO_COMPILE = "--xla_cpu_use_fusion_emitters=false"
"""XLA's older code generator for a CPU: half as long to compile, programs up to 1.4 times as slow.

With ``--xla_backend_optimization_level=1`` tests take 1.08 times the processor time (167 tests with empty caches).
Add no ``--xla_backend_optimization_level=0``: in jax 0.10.1 this generator then gives gradients that are zero in silence
(the derivative of a union of a sphere and a box by the sphere's radius). Either flag alone is right.
"""


def _knows(flags: str) -> bool:
    """Whether this XLA has the flags: one that lacks one ends the process."""
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", "import jax; jax.devices()"]
    return subprocess.run(command, env=environment, capture_output=True).returncode == 0


# Before jax starts. Workers inherit it. Flags that are set, even to nothing (`XLA_FLAGS= pytest`), stay as they are.
if "XLA_FLAGS" not in os.environ and _knows(_QUICK_TO_COMPILE):
    os.environ["XLA_FLAGS"] = _QUICK_TO_COMPILE

_CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rewax" / "jax-tests"
jax.config.update("jax_compilation_cache_dir", str(_CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # the workers share even the smallest programs

hypothesis.settings.register_profile(
    "rewax",
    max_examples=12,
    deadline=None,
    derandomize=True,
    print_blob=True,
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],
)
hypothesis.settings.load_profile("rewax")


# Tracing makes millions of objects that live as long as their trace. Python's collector walks through them, and through
# all modules, again and again: a fifth of the time of the tests.
gc.disable()


def pytest_collection_finish() -> None:
    """Modules and tests are never garbage; of the rest the collector waits for more than usual."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With ``pytest -n`` each worker begins with half of the files, so that tests of a file share what they compile.

    Pytest without xdist has no such hook and no option ``--dist``.
    """
    if config.getvalue("dist") != "load":
        return None  # asked for something else
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)


_SLOW_CASES = Path(__file__).with_name("slow_cases.txt")
"""Tests that take long, and of which other cases or smaller tests run: marked as slow, one name a line."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks the tests of the list as slow. A line of the list that names no test of a collected file is an error."""
    listed = set(_SLOW_CASES.read_text().splitlines())
    for item in items:
        if item.nodeid in listed:
            item.add_marker(pytest.mark.slow)
    found = {item.nodeid for item in items}
    files = {name.split("::")[0] for name in found}
    unknown = sorted(name for name in listed - found if name.split("::")[0] in files)
    if unknown and not any("::" in argument for argument in config.args):
        raise pytest.UsageError(f"{_SLOW_CASES.name} names tests that are not there: {', '.join(unknown)}")


_C_LIBRARY = ctypes.CDLL(None) if sys.platform == "linux" else None
_MANY_MAPS = 40_000
"""Linux lets a process map 65530 pieces of memory; every compiled program takes some, and beyond it crashes."""
_MUCH_MEMORY = 0.25
"""Share of the machine's memory that a process may take, of which there are two [-]."""


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """Compiled programs of earlier modules go before they are too many or too large; the cache on disk keeps them."""
    yield
    process = Path("/proc/self")
    if not process.is_dir():
        return
    resident = int((process / "statm").read_text().split()[1]) / os.sysconf("SC_PHYS_PAGES")
    if resident > _MUCH_MEMORY or (process / "maps").read_bytes().count(b"\n") > _MANY_MAPS:
        jax.clear_caches()
        gc.collect()
        if hasattr(_C_LIBRARY, "malloc_trim"):  # glibc keeps freed memory, and the worker would grow by as much
            _C_LIBRARY.malloc_trim(0)


@pytest.fixture(scope="module", autouse=True)
def algorithms_of_rewax() -> Iterator[None]:
    """Algorithms that a module registers, as pages of the manual do, are gone for the next one in the same process."""
    from rewax.agents import registry

    before = dict(registry._ALGORITHMS)
    yield
    registry._ALGORITHMS.clear()
    registry._ALGORITHMS.update(before)


@pytest.fixture(scope="session")
def sharing_programs() -> dict[str, str]:
    """The environment of another Python that keeps compiled programs where the tests do."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(_CACHE), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return {**os.environ, **cache}


@pytest.fixture
def x64() -> Iterator[None]:
    """The test runs with float64 as the default."""
    with jax.enable_x64(True):
        yield


def _norm(tree) -> float:
    return float(np.sqrt(sum(np.sum(np.square(np.asarray(leaf, np.float64))) for leaf in jax.tree.leaves(tree))))


@pytest.fixture(scope="session")
def relative_error():
    """``relative_error(a, b)``: |a - b| / |b| over all leaves of two trees."""

    def error(a, b) -> float:
        difference = jax.tree.map(lambda x, y: np.asarray(x, np.float64) - np.asarray(y, np.float64), a, b)
        return _norm(difference) / max(_norm(b), 1e-300)

    return error


@pytest.fixture(scope="session")
def random_like():
    """``random_like(seed, tree)``: a tree of standard normal numbers of the same shapes and dtypes."""

    def make(seed: int, tree):
        rng = np.random.default_rng(seed)
        return jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(jnp.shape(a)), jnp.result_type(a)), tree)

    return make


@pytest.fixture(scope="session")
def central_difference():
    """``central_difference(f, x, dx, step)``: (f(x + step dx) - f(x - step dx)) / (2 step), of trees."""

    def difference(f, x, dx, step: float = 1e-6):
        ahead = f(jax.tree.map(lambda a, d: a + step * d, x, dx))
        behind = f(jax.tree.map(lambda a, d: a - step * d, x, dx))
        return jax.tree.map(lambda a, b: (a - b) / (2.0 * step), ahead, behind)

    return difference


@pytest.fixture(scope="session")
def inner():
    """``inner(a, b)``: the scalar product of two trees of one structure."""

    def product(a, b) -> float:
        return sum(float(jnp.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))

    return product


@pytest.fixture(scope="session")
def derivatives():
    """``derivatives(f)(x, dx, weights)``: f(x), its forward derivative along dx, its reverse derivative of weights.

    One compiled program; ``weights`` is a function of f(x) that is called while tracing. Further arguments of
    ``derivatives`` are ``jax.jit``'s. It is compiled quickly rather than well.
    """

    def of(f, **options):
        @functools.partial(jax.jit, static_argnames="weights", **{"compiler_options": unoptimised(), **options})
        def all_three(x, dx, weights):
            value, forward = jax.linearize(f, x)
            chosen = weights(value)
            return value, forward(dx), chosen, jax.linear_transpose(forward, x)(chosen)[0]

        return all_three

    return of


@pytest.fixture(scope="session")
def derivatives_agree(derivatives, random_like, central_difference, relative_error, inner):
    """``derivatives_agree(f, x, dx, step=, bar=, exact=)``: f(x), and its reverse derivative of random weights.

    Asserts that the forward derivative along dx is the central difference, with an error below ``bar``, and that the
    reverse derivative is the forward one, with an error below ``exact``. Values of f may be trees.
    """

    def check(f, x, dx, *, step, bar, exact):
        program = derivatives(f)

        def weights(value):
            return random_like(2, value)

        value, forward, chosen, reverse = program(x, dx, weights)
        difference = central_difference(lambda x: program(x, dx, weights)[0], x, dx, step)
        assert relative_error(forward, difference) < bar
        np.testing.assert_allclose(inner(reverse, dx), inner(chosen, forward), rtol=exact)
        return value, reverse

    return check


@pytest.fixture(scope="session")
def least_error(inner, central_difference):
    """``least_error(f, args, move, cotangent, slope, steps, bar)``: of a slope from central differences, relative.

    It is that of the first of the steps whose error is below ``bar``, else the least one.
    """

    def of(f, args, move, cotangent, slope, *, steps, bar):
        least = np.inf
        for step in steps:
            difference = inner(cotangent, central_difference(f, args, move, step))
            least = min(least, abs(slope - difference) / max(abs(difference), 1e-3))
            if least < bar:
                break
        return least

    return of


@pytest.fixture(scope="session")
def agree_along(derivatives, inner):
    """``agree_along(f, args, directions)``: reverse = forward = central difference of a scalar function.

    ``directions`` holds trees like ``args``, by name; the slope along each is more than ``least``. ``f(*args)`` and its
    derivatives are one compiled program. The difference is of fourth order in ``step`` if ``fourth``.
    """

    def check(f, args, directions, *, step, exact, bar, least=1e-6, fourth=False):
        whole = derivatives(lambda args: f(*args))
        args, directions = jax.tree.map(strongly_typed, (args, directions))  # else each form is a program of its own
        for name, along in directions.items():

            def apart(size, along=along):
                ends = [jax.tree.map(lambda a, d, s=s: a + s * size * d, args, along) for s in (1, -1)]
                ahead, behind = (float(whole(end, along, weights=jnp.ones_like)[0]) for end in ends)
                return (ahead - behind) / (2.0 * size)

            _, forward, _, slopes = whole(args, along, weights=jnp.ones_like)
            reverse = inner(slopes, along)
            difference = (4.0 * apart(step) - apart(2.0 * step)) / 3.0 if fourth else apart(step)
            assert abs(reverse) > least, name
            np.testing.assert_allclose(reverse, forward, rtol=exact, err_msg=name)
            np.testing.assert_allclose(reverse, difference, rtol=bar, err_msg=name)

    return check
