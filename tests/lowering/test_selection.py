"""Which instructions cover a program, and when a register is free again."""

import jax
import jax.numpy as jnp

from rewax.lowering.from_jaxpr import from_jaxpr
from rewax.lowering.selection import Cover, Registers, needed_for


def cover(function, *args):
    """The operations of a function of numbers, and the steps that compute them in lanes."""
    listing = from_jaxpr(jax.make_jaxpr(function)(*args), [True] * len(args), loops=True)
    needed = needed_for(listing, listing.outputs)
    loops = {i for loop in listing.loops for i in (loop.condition, *loop.following)}
    kept = {i for output in listing.outputs for i in output} | loops
    return listing, Cover(listing.operations, needed, kept, lanes=True).steps()


def test_one_instruction_computes_a_tree_of_operations():
    _, steps = cover(lambda a, b, c: a * b + c, 1.0, 2.0, 3.0)
    assert [step.instruction for step in steps] == [("add", ("mul", "f", "f"), "f")]


def test_a_value_that_two_operations_read_is_computed_by_itself():
    _, steps = cover(lambda a, b: (a * b + a, a * b + b), 1.0, 2.0)
    assert [step.instruction[0] for step in steps] == ["mul", "add", "add"]


def test_what_is_computed_before_a_loop_is_no_part_of_an_instruction_in_it():
    """It would be computed again in each turn."""
    listing, steps = cover(lambda a, b: jax.lax.while_loop(lambda s: s < 9.0, lambda s: s + a * b, a), 1.0, 2.0)
    places = {step.instruction: listing.operations[step.operation].place for step in steps}
    assert places["mul", "f", "f"] == () and places["add", "f", "f"] == (1,)


def test_what_no_result_needs_is_left_out():
    listing = from_jaxpr(jax.make_jaxpr(lambda a: (jnp.sin(a), a + 1.0)[1])(1.0), [True])
    assert "sin" not in {listing.operations[i].name for i in needed_for(listing, listing.outputs)}


def test_the_value_after_a_loop_needs_the_loop():
    def function(a):
        return jax.lax.while_loop(lambda s: s[0] < 9.0, lambda s: (s[0] + jnp.exp(a), jnp.tan(s[1])), (a, a))[0]

    listing = from_jaxpr(jax.make_jaxpr(function)(1.0), [True], loops=True)
    names = {listing.operations[i].name for i in needed_for(listing, listing.outputs)}
    assert {"exp", "lt", "select"} <= names
    assert "tan" not in names, "another value of the loop, which nobody reads"


def test_a_register_is_used_again_after_the_last_read():
    _, steps = cover(lambda a: jnp.sin(jnp.cos(jnp.tan(a))), 1.0)
    registers = Registers(steps, {steps[-1].operation})
    for k, step in enumerate(steps):
        registers.release(k, step.operands)
        registers.take(step.operation)
    assert registers.count == 1
