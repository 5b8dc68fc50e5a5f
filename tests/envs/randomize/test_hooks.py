"""Parameters by name: what is drawn, together or apart, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import rewax
from rewax import struct
from rewax.envs import Randomized, Vmap
from rewax.envs.randomize import Constant, LogUniform, Per, Scale, Shift, Uniform, hook, leaves, with_numbers

KEY = jax.random.key(3)
STIFFNESS = ("material.youngs_modulus", "material.yield_stress")


@struct.dataclass
class Material:
    youngs_modulus: jax.Array
    yield_stress: jax.Array


@struct.dataclass
class Tool:
    friction: object


@struct.dataclass
class Things:
    """Every kind of parameter that an environment can have."""

    material: Material
    parameters: dict
    tools: tuple
    start: jax.Array
    count: jax.Array
    number: object = 0.0
    whole: object = 2


THINGS = Things(
    material=Material(youngs_modulus=jnp.float32(800.0), yield_stress=jnp.float32(20.0)),
    parameters={"body_mass": jnp.array([0.0, 1.0, 2.0]), "body_inertia": jnp.ones((3, 3)) * jnp.arange(3.0)[:, None]},
    tools=(Tool(friction=jnp.float32(0.2)), Tool(friction=jnp.float32(0.8))),
    start=jnp.arange(12.0).reshape(4, 3),
    count=jnp.int32(3),
)


def drawn(draws, key=KEY, env=THINGS):
    return hook(draws)(key, env)


def changed(new, old=THINGS):
    names, before, after = leaves(old), jax.tree.leaves(old), jax.tree.leaves(new)
    known = [
        jax.tree_util.keystr(path).removeprefix(".").replace("'", "") for path, _ in jax.tree.leaves_with_path(old)
    ]
    assert set(names) <= set(known)
    return {n for n, a, b in zip(known, before, after, strict=True) if not np.array_equal(a, b)}


def test_only_what_is_named_changes_and_shapes_stay():
    draws = {
        "material.youngs_modulus": Uniform(500.0, 700.0),
        "parameters[body_mass]": Scale(Uniform(0.5, 0.9)),
        "start": Shift(Uniform(0.1, 0.2, per=Per.ELEMENT)),
    }
    new = drawn(draws)
    assert changed(new) == set(draws)
    assert jax.tree.structure(new) == jax.tree.structure(THINGS)
    for a, b in zip(jax.tree.leaves(new), jax.tree.leaves(THINGS), strict=True):
        assert jnp.shape(a) == jnp.shape(b) and jnp.result_type(a) == jnp.result_type(b)
    assert 500.0 <= new.material.youngs_modulus < 700.0
    factor = new.parameters["body_mass"][1:] / THINGS.parameters["body_mass"][1:]
    assert 0.5 <= factor[0] < 0.9 and factor[0] == factor[1] and new.parameters["body_mass"][0] == 0.0
    shift = np.asarray(new.start - THINGS.start)
    assert (shift > 0.0999).all() and (shift < 0.2001).all() and len(np.unique(shift.round(5))) == 12


def test_leaves_of_one_draw_move_together():
    new = drawn({STIFFNESS: Scale(LogUniform(0.5, 2.0))})
    np.testing.assert_allclose(new.material.youngs_modulus / 800.0, new.material.yield_stress / 20.0, rtol=1e-6)
    apart = drawn({name: Scale(LogUniform(0.5, 2.0)) for name in STIFFNESS})
    assert abs(apart.material.youngs_modulus / 800.0 - apart.material.yield_stress / 20.0) > 1e-3
    tools = drawn({"tools[*].friction": Uniform(0.0, 1.0)}).tools
    assert tools[0].friction == tools[1].friction


def test_rows_of_one_draw_move_together():
    """Each body heavier by a factor of its own, and its inertia by the same."""
    new = drawn({("parameters[body_mass]", "parameters[body_inertia]"): Scale(Uniform(0.5, 2.0, per=Per.ROW))})
    mass, inertia = new.parameters["body_mass"], new.parameters["body_inertia"]
    np.testing.assert_allclose(
        inertia[1:] / jnp.array([[1.0], [2.0]]), jnp.tile((mass[1:] / jnp.array([1.0, 2.0]))[:, None], 3), rtol=1e-6
    )
    assert abs(mass[1] - mass[2] / 2.0) > 1e-3


def test_a_part_of_a_leaf():
    new = drawn({"start[1,-1]": Constant(7.0), "start[:][0]": Shift(Constant(-1.0))})
    expected = np.arange(12.0).reshape(4, 3)
    expected[:, 0] -= 1.0
    expected[1, 2] = 7.0
    np.testing.assert_array_equal(new.start, expected)


def test_a_name_may_be_written_as_python_prints_it():
    plain = drawn({"parameters[body_mass]": Scale(Constant(2.0))})
    for name in (".parameters['body_mass']", "parameters.body_mass", 'parameters["body_mass"]'):
        np.testing.assert_array_equal(
            drawn({name: Scale(Constant(2.0))}).parameters["body_mass"], plain.parameters["body_mass"]
        )


def test_one_number_is_drawn_as_it_is():
    new = drawn({"number": Uniform(0.2, 0.4)})
    assert isinstance(new.number, jax.Array) and new.number.dtype == jnp.float32 and 0.2 <= new.number < 0.4
    state = Randomized(
        env=rewax.make("RollingFlat", scale="small"),
        randomize=hook({"scene.colliders[*].friction": Uniform(0.2, 0.4)}),
    )
    found = jax.jit(state.reset)(KEY).drawn
    assert len(found) == 1 and all(0.2 <= value < 0.4 for value in found.values())


def test_draws_depend_on_key_and_names_alone():
    draws = {"material.youngs_modulus": Uniform(0.0, 1.0), "start": Uniform(0.0, 1.0)}
    one, again, other = drawn(draws), jax.jit(hook(draws))(KEY, THINGS), drawn(draws, jax.random.key(4))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert one.material.youngs_modulus != other.material.youngs_modulus
    assert one.material.youngs_modulus != one.start[0, 0]
    alone = drawn({"start": Uniform(0.0, 1.0)})
    np.testing.assert_array_equal(alone.start, one.start)
    backwards = drawn(dict(reversed(draws.items())))
    np.testing.assert_array_equal(backwards.start, one.start)


def test_environments_side_by_side_differ():
    env = Randomized(env=toys.point_mass(), randomize=hook({"gain": Scale(Uniform(0.5, 2.0))}))
    keys = jax.random.split(KEY, 500)
    gains = np.asarray(Vmap(env=env).reset(keys).drawn[".gain"])
    assert len(set(gains)) == 500 and (gains >= 0.25).all() and (gains <= 1.0).all()
    assert abs(gains.mean() - 0.625) < 4 * (0.75 / 12**0.5) / 500**0.5
    np.testing.assert_array_equal(gains[7], env.reset(keys[7]).drawn[".gain"])


def test_gradients_reach_the_environment_through_factor_and_shift():
    def mass(env, draws):
        return hook(draws)(KEY, env).parameters["body_mass"].sum()

    factor = drawn({"parameters[body_mass]": Scale(Uniform(0.5, 2.0))}).parameters["body_mass"][1]
    for draw, slope in ((Scale(Uniform(0.5, 2.0)), factor), (Shift(Uniform(0.5, 2.0)), 1.0), (Uniform(0.5, 2.0), 0.0)):
        gradient = jax.grad(mass, allow_int=True)(THINGS, {"parameters[body_mass]": draw})
        np.testing.assert_allclose(gradient.parameters["body_mass"], slope * np.ones(3), rtol=1e-6)


def test_all_leaves_are_listed():
    names = set(leaves(THINGS))
    assert {"tools[1].friction", "parameters[body_mass]", "material.youngs_modulus", "number"} < names
    assert not {"count", "whole"} & names
    ant = rewax.make("CartpoleSwingUp", scale="small")
    assert leaves(ant)["model.parameters[body_mass]"] is ant.model.parameters["body_mass"]
    heavier = hook({"model.parameters[body_mass]": Scale(Constant(2.0))})(KEY, ant)
    np.testing.assert_array_equal(heavier.model.parameters["body_mass"], 2.0 * ant.model.parameters["body_mass"])


ONE = Uniform(0.5, 1.0)
REFUSED = {
    r"^Things has no parameter 'material.young_modulus': near are material.youngs_modulus; rewax.envs.randomize.leaves\(env\) has all 8 by name$": {
        "material.young_modulus": ONE
    },
    r"^Things has no parameter 'youngs_modulus': near are material.youngs_modulus; ": {"youngs_modulus": ONE},
    r"^Things has no parameter 'material': near are material.yield_stress, material.youngs_modulus; ": {
        "material": ONE
    },
    r"^Things has no parameter 'xyz': rewax.envs.randomize.leaves": {"xyz": ONE},
    r"^start\[4\] is no part of the parameter start, which has shape \(4, 3\): give indices within it$": {
        "start[4]": ONE
    },
    r"^number\[0\] is no part of the parameter number, which has shape \(\)": {"number[0]": ONE},
    r"^start.x continues after the parameter start: end there, or give indices as in start\[0\]$": {"start.x": ONE},
    r"^start is drawn twice: give it one distribution$": {"start": ONE, ".start": Shift(ONE)},
    r"^start\[3\]\[2\] is drawn twice": {"start[3,2]": ONE, "start[-1,-1]": ONE},
    r"^tools\[1\].friction is drawn twice": {"tools[*].friction": ONE, "tools[1].friction": ONE},
    r"^start\[1\] is drawn twice": {"start": Scale(ONE), "start[1]": Shift(ONE)},
    r"^start is drawn twice": {"start[1]": Shift(ONE), "start": Scale(ONE)},
    r"^count is of type int32: only floats can be drawn; give the environment a float there$": {"count": ONE},
    r"^whole is of type int32: only floats can be drawn": {"whole": ONE},
    r"^number is 0.0, which no factor changes: give its values, as in Uniform\(0.1, 0.5\)$": {"number": Scale(ONE)},
    r"^number is one number, but its draw has Per.ROW: leave per out$": {"number": Uniform(0.5, 1.0, per=Per.ROW)},
    r"^start has shape \(4, 3\) and parameters\[body_mass\] \(3,\): they cannot share a draw with Per.ROW; draw them": {
        ("start", "parameters[body_mass]"): Scale(Uniform(0.5, 1.0, per=Per.ROW))
    },
    r"^draws is \{\}: give a dict, as in \{'scene.material.density': Uniform": {},
    r"^the draw of start is 0.5: give a distribution, Scale\(...\), Shift\(...\) or Turn\(...\)$": {"start": 0.5},
    r"^3 is no name of a parameter: give a string, or a tuple of strings that share a draw$": {3: ONE},
}


@pytest.mark.parametrize("sentence", REFUSED, ids=range(len(REFUSED)))
def test_what_cannot_be_drawn_is_said_in_a_sentence(sentence):
    with pytest.raises(ValueError, match=sentence) as caught:
        drawn(REFUSED[sentence])
    assert "\n" not in str(caught.value)


def test_given_numbers_take_the_place_of_draws_with_an_exact_gradient():
    draws = hook(
        {("material.youngs_modulus", "start[1]"): Uniform(0.0, 1e3), "tools[*].friction": Scale(Uniform(0.5, 2.0))}
    )
    new = with_numbers(THINGS, draws, [jnp.float32(7.0), jnp.float32(3.0)])
    assert float(new.material.youngs_modulus) == 7.0 and np.all(np.asarray(new.start[1]) == 7.0)
    np.testing.assert_allclose([float(tool.friction) for tool in new.tools], [0.6, 2.4], rtol=1e-6)
    assert changed(new) == {"material.youngs_modulus", "start", "tools[0].friction", "tools[1].friction"}

    def total(number):
        new = with_numbers(THINGS, draws, [number, jnp.float32(3.0)])
        return new.material.youngs_modulus + new.start.sum()

    assert float(jax.grad(total)(jnp.float32(7.0))) == 4.0
    twice = hook({"start[1]": Uniform(0.0, 1.0), "start": Uniform(0.0, 1.0)})
    with pytest.raises(ValueError, match="start is drawn twice"):  # else the first would have a gradient of zero
        with_numbers(THINGS, twice, [jnp.float32(7.0), jnp.float32(3.0)])
