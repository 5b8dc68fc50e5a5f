"""Random programs through ``rewax.lowering``, against JAX: values, forward and reverse derivatives.

    python benchmarks/fuzz_lowering.py --programs 5000                # half interpreted, half pointwise
    python benchmarks/fuzz_lowering.py --programs 200 --first 40 --way pointwise

Prints what was compared and refused, by reason, and every wrong number with its program's seed. Exit status 1 if any is
wrong. A number is right if it equals that of a compiled program of JAX, of JAX operation by operation, or of JAX with
other signs of computed zeros, up to rounding. The same program in double precision judges what rounding does. Infinite
numbers and NaN are right only where one of these gives the same.
"""

import argparse
import collections
import random
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.random_programs import RandomProgram, Step, draw_inputs, draw_program
from rewax.lowering import interpreted, pointwise, report

BATCHES = [0, 1, 2, 3, 7, 16, 17, 33, 100, 1000]
WAYS = ("interpreted", "pointwise")
RULES = ("value", "jvp", "vjp")


SIGNS = 6
"""Draws of the signs of zeros."""


class Outcome(NamedTuple):
    """What became of one program."""

    compared: int
    """Rules that ran in C++ and were compared."""
    refused: tuple[str, ...]
    """Reasons of the others."""
    wrong: tuple[str, ...]
    """A sentence for each result that is not JAX's."""


def check_program(rng: random.Random, way: str, *, precision: type = np.float32) -> Outcome:
    """Draw a program and compare its lowered form with JAX."""
    with jax.enable_x64(precision == np.float64):
        program = draw_program(rng)
    batch, extreme = rng.choice(BATCHES if way == "interpreted" else BATCHES[1:]), rng.choice([0.0, 0.0, 0.1, 0.4])
    inputs = draw_inputs(rng, program, (batch,), extreme, precision)
    seed = rng.randrange(2**31)
    rule, around = rng.choice(RULES), rng.choice(["", "", "", "scan"])
    if rule != "value" and any(name.startswith("apply") for name in program.names):
        rule = "value"  # JAX cannot differentiate it
    with jax.enable_x64(precision == np.float64), report.recorded() as decisions, warnings.catch_warnings():
        warnings.simplefilter("ignore", report.LoweringWarning)
        found = _results(_lowered(program, way), inputs, rule, seed, around)
        reasons = tuple(dict.fromkeys(d.reason for d in decisions if d.reason))
        if reasons:
            return Outcome(0, reasons, ())
        expected = _results(jax.vmap(program), inputs, rule, seed, around)
    if all(_same(f, e) for f, e in zip(found, expected, strict=True)):
        return Outcome(1, (), ())
    return Outcome(1, (), _explained(program, inputs, rule, seed, around, found, expected, precision))


def _lowered(program: RandomProgram, way: str) -> Callable[..., Any]:
    if way == "interpreted":
        return jax.vmap(interpreted(lambda *arrays: program(*arrays)))

    def elements(shared: None, arrays: Any) -> Any:
        return jax.vmap(program, in_axes=-1, out_axes=-1)(*arrays)

    call = pointwise(elements)

    def of_batch(*arrays: Any) -> Any:
        moved = tuple(jnp.moveaxis(a, 0, -1) for a in arrays)
        return tuple(jnp.moveaxis(r, -1, 0) for r in call(None, moved))

    return of_batch


def _results(
    function: Callable[..., Any], inputs: list, rule: str, seed: int, around: str, *, jit: bool = True
) -> list:
    """Value or a derivative along directions, or with weights, that are drawn from the seed."""
    draw = np.random.default_rng(seed)
    floats = [k for k, a in enumerate(inputs) if np.issubdtype(a.dtype, np.floating)]

    def run(arrays: list, values: tuple) -> Any:
        def of_floats(*values: Any) -> Any:
            merged = list(arrays)
            for k, value in zip(floats, values, strict=True):
                merged[k] = value
            return function(*merged)

        if rule == "value":
            return of_floats(*values)
        if rule == "jvp":
            tangents = tuple(jnp.asarray(draw.choice([-1.0, 0.5, 2.0], np.shape(v)), v.dtype) for v in values)
            return jax.jvp(of_floats, values, tangents)
        out, pull = jax.vjp(of_floats, *values)
        return out, pull(tuple(jnp.asarray(draw.choice([-1.0, 0.5, 2.0], o.shape), o.dtype) for o in out))

    def once(arrays: list, values: tuple) -> Any:
        if around != "scan":
            return run(arrays, values)
        first = jax.eval_shape(run, arrays, values)
        zero = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), first)
        return jax.lax.scan(lambda _, __: (run(arrays, values), None), zero, None, length=2)[0]

    # All are arguments: XLA 0.10.1 dies of some divisions of integers that are constants.
    arrays = [jnp.asarray(a) for a in inputs]
    out = (jax.jit(once) if jit else run)(arrays, tuple(arrays[k] for k in floats))
    return [np.asarray(a) for a in jax.tree.leaves(out)]


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    with np.errstate(all="ignore"):
        return bool(np.all(_close(a, b, 200 * np.finfo(a.dtype).eps * np.maximum(np.abs(b), 1.0))))


def _close(a: np.ndarray, b: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Where ``a`` is ``b``, up to ``scale`` if that is a number; shape of both."""
    return np.isfinite(b) & (np.abs(a - b) <= scale) | (a == b) | np.isnan(a) & np.isnan(b)


def _explained(
    program: RandomProgram, inputs: list, rule: str, seed: int, around: str, found: list, expected: list, dtype: type
) -> tuple[str, ...]:
    """Sentences about what neither rounding nor the signs of zeros explain."""
    with jax.enable_x64(True):
        doubled = [a.astype(np.float64) if np.issubdtype(a.dtype, np.floating) else a for a in inputs]
        exact = _results(jax.vmap(program), doubled, rule, seed, around)
    with jax.enable_x64(dtype == np.float64):
        stepwise = _results(jax.vmap(program), inputs, rule, seed, around, jit=False)
        signed = [
            _results(jax.vmap(_with_signs(program, rule, draw)), inputs, rule, seed, around) for draw in range(SIGNS)
        ]
    wrong = []
    for k, (f, e, s, d, *others) in enumerate(zip(found, expected, stepwise, exact, *signed, strict=True)):
        if (f.shape, f.dtype) != (e.shape, e.dtype):
            wrong.append(f"{rule} result {k}: {f.dtype}{list(f.shape)} for JAX's {e.dtype}{list(e.shape)}")
            continue
        with np.errstate(all="ignore"):
            rounding = np.maximum(np.abs(e - d), np.abs(s - d))
            rounding = 30 * np.where(np.isfinite(rounding), rounding, 0)
            scales = [np.maximum(np.abs(r), 1.0) * 300 * np.finfo(f.dtype).eps + rounding for r in (e, s, *others)]
            bad = ~np.any([_close(f, r, scale) for r, scale in zip((e, s, *others), scales, strict=True)], axis=0)
        if bad.any():
            at = tuple(int(i) for i in np.argwhere(bad)[0])
            wrong.append(f"{rule} result {k}{at}: {f[at]} for JAX's {e[at]} (stepwise {s[at]}, double {d[at]})")
    return tuple(wrong)


def _with_signs(program: RandomProgram, rule: str, seed: int) -> RandomProgram:
    """The program where computed zeros have other signs.

    A sum of negative zeros is a negative zero here, a positive one in JAX: quotients and angles tell them apart.
    """
    signs = random.Random(seed)

    def draw(step: Step) -> Step:
        function, used = step
        flip = _zeros_as(signs.choice([0.0, -0.0]), signs.choice([0.0, -0.0]), rule)
        return (lambda *a: flip(function(*a))), used

    return program._replace(steps=[draw(step) for step in program.steps])


def _zeros_as(zero: float, of_derivative: float, rule: str) -> Callable[[Any], Any]:
    """A function that gives zeros, and those of its derivatives, a sign."""

    def put(a: Any, zero: float) -> Any:
        return jnp.where(a == 0, jnp.asarray(zero, a.dtype), a)

    if rule == "vjp":
        flip = jax.custom_vjp(lambda a: put(a, zero))
        flip.defvjp(lambda a: (put(a, zero), None), lambda _, g: (put(g, of_derivative),))
    else:
        flip = jax.custom_jvp(lambda a: put(a, zero))
        flip.defjvp(lambda a, t: (put(a[0], zero), put(t[0], of_derivative)))
    return lambda a: flip(a) if jnp.issubdtype(a.dtype, jnp.floating) else a


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--programs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first program")
    parser.add_argument("--way", choices=WAYS, default=None, help="both, in turns, if left out")
    arguments = parser.parse_args()
    reasons: collections.Counter[str] = collections.Counter()
    compared = refused = wrong = 0
    began = time.perf_counter()
    for seed in range(arguments.first, arguments.first + arguments.programs):
        way = arguments.way or WAYS[seed % 2]
        precision = np.float64 if seed % 5 == 4 else np.float32
        outcome = check_program(random.Random(seed), way, precision=precision)
        compared, refused = compared + outcome.compared, refused + bool(outcome.refused)
        reasons.update(outcome.refused)
        wrong += bool(outcome.wrong)
        for sentence in outcome.wrong:
            print(f"WRONG seed {seed}, {way}, {precision.__name__}: {sentence}", flush=True)
        if seed % 20 == 19:
            jax.clear_caches()
        if seed % 200 == 199:
            print(f"{seed + 1 - arguments.first} programs, {time.perf_counter() - began:.0f} s", flush=True)
    print(f"{compared} compared, {wrong} wrong, {refused} refused:")
    for reason, count in reasons.most_common():
        print(f"  {count:5d}  {reason}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
