"""Environments by name: options and their spelling, recipes, and what is imported when."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import rewax
from rewax.envs import registry

HEAVY = (
    "mujoco",
    "distrax",
    "tensorflow_probability",
    "orbax",
    "matplotlib",
    "tyro",
    "rich",
    "flax",
    "optax",
    "trimesh",
)


def toy(*, scale, length=5, gain=0.5):
    del scale
    return toys.PointMass(gain=jnp.asarray(gain), length=length)


@pytest.fixture
def known(monkeypatch):
    """A registry of a few toys."""
    monkeypatch.setattr(registry, "_FACTORIES", {})
    registry.register("Toy", toy)
    registry.register("PassedOn", lambda scale, **kwargs: toy(scale=scale, **kwargs))
    registry.register("ByScale", {"paper": lambda *, width=2: toy(scale=None, length=width), "small": toys.point_mass})
    registry.register("ByName", "toys:point_mass_of_scale")
    registry.register("Plain", lambda scale: toys.point_mass())
    registry.register("Picky", lambda scale, length: toys.point_mass(length))
    registry.register("Unscaled", lambda length=5: toys.point_mass(length))


@pytest.mark.parametrize(
    ("name", "kwargs", "sentence"),
    [
        ("RollingFlat", {"youngs_modulu": 5.0}, "RollingFlat has no option 'youngs_modulu': did you mean 'youngs_modulus'? use youngs_modulus, yield_stress, dt, num_substeps"),
        ("AntRun", {"onsett": 0.1}, "AntRun has no option 'onsett': did you mean 'onset'? use onset, stale_mass_matrix, dt, num_substeps"),
        ("Ant", {"onset": 0.1}, "Ant has no option 'onset': use dt, num_substeps"),
    ],
)  # fmt: skip
def test_a_misspelt_option_is_one_sentence(name, kwargs, sentence):
    with pytest.raises(ValueError) as caught:
        rewax.make(name, scale="small", **kwargs)
    assert str(caught.value) == sentence


@pytest.mark.parametrize(
    ("name", "kwargs", "sentence"),
    [
        ("Toy", {"lenght": 3}, "Toy has no option 'lenght': did you mean 'length'? use length, gain"),
        ("PassedOn", {"lenght": 3}, "PassedOn has no option 'lenght': toy() got an unexpected keyword"),
        ("ByScale", {"scale": "paper", "length": 3}, "ByScale has no option 'length': use width"),
        ("Plain", {"length": 3}, "Plain has no option 'length': it has none"),
        ("Picky", {}, "Picky needs the option 'length': give make('Picky', length=...)"),
        ("Unscaled", {}, "the factory of 'Unscaled' takes no scale: define it as factory(*, scale, ...)"),
        ("ByName", {}, "the factory of 'ByName' is 'toys:point_mass_of_scale', but toys has no point_mass_of_scale"),
        (
            "Toi",
            {},
            "there is no environment named 'Toi': did you mean 'Toy'? known are ByName, ByScale, PassedOn, Picky",
        ),
        (7, {}, "there is no environment named 7: known are"),
        ("Toy", {"scale": ["small"]}, "scale is ['small']: did you mean 'small'? use one of 'paper', 'small'"),
    ],
)
def test_what_cannot_be_made_is_said(known, name, kwargs, sentence):
    with pytest.raises(ValueError) as caught:
        rewax.make(name, **kwargs)
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)


def test_scales_may_have_factories_and_options_of_their_own(known):
    assert rewax.make("ByScale", scale="paper", width=9).episode_length == 9
    assert rewax.make("ByScale", scale="small", length=3).episode_length == 3
    assert rewax.make("PassedOn", scale="small", length=3).episode_length == 3


def test_a_string_must_name_module_and_function(known):
    with pytest.raises(
        ValueError, match=r"the factory of 'New' is 'toys': give a function or 'package.module:function'"
    ):
        registry.register("New", "toys")
    assert "New" not in registry.list_envs()


@pytest.mark.parametrize(("scales", "shown"), [({}, "none"), ({3: toy}, "3")])
def test_factories_by_scale_have_scales(known, scales, shown):
    with pytest.raises(ValueError, match=f"^the scales of 'New' are {shown}: give each a name, {{'small': "):
        registry.register("New", scales)
    with pytest.raises(ValueError, match=r"^the factory of 'New' is None: give a function"):
        registry.register("New", {"small": None})


def test_a_factory_returns_no_class(known):
    registry.register("Class", lambda scale: toys.PointMass)
    with pytest.raises(ValueError, match=r"^the factory of 'Class' returned the class PointMass: return an env"):
        rewax.make("Class")


@pytest.mark.parametrize(
    ("env", "sentence"),
    [
        ("Toy", "env is 'Toy': give an environment, rewax.make('Toy') for example"),
        ("Toi", "env is 'Toi': give an environment, rewax.make('RollingFlat') for example"),
        (None, "env is None: give an environment, "),
        (toys.PointMass, "env is <class 'toys.PointMass'>: give an environment, "),
    ],
)
def test_what_is_no_environment_is_said(known, env, sentence):
    registry.require_env(toys.point_mass())
    with pytest.raises(ValueError) as caught:
        registry.require_env(env)
    assert str(caught.value).startswith(sentence)


def test_an_environment_knows_its_recipe_until_it_is_changed():
    env = rewax.make("RollingFlat", scale="small", youngs_modulus=400.0)
    assert env.made_by == {"env": "RollingFlat", "scale": "small", "kwargs": {"youngs_modulus": 400.0}}
    again = rewax.make(env.made_by["env"], scale=env.made_by["scale"], **env.made_by["kwargs"])
    for a, b in zip(jax.tree.leaves(env), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not hasattr(env.replace(max_steps=3), "made_by")
    assert not hasattr(jax.tree.map(lambda leaf: leaf, env), "made_by")
    assert jax.tree.structure(env) == jax.tree.structure(jax.tree.map(lambda leaf: leaf, env))


@pytest.mark.parametrize("four", [np.int64(4), np.float32(4.0), jnp.asarray(4)])
def test_a_recipe_holds_numbers_that_json_takes(known, four):
    assert rewax.make("Toy", length=four).made_by["kwargs"] == {"length": 4}
    assert json.dumps(registry.recipe(rewax.make("Toy", length=four)))
    assert registry.recipe(rewax.make("Toy", gain=np.ones(2))) is registry.recipe(toy(scale="small")) is None


def test_made_by_holds_the_scale_that_the_device_chose(known):
    assert rewax.make("Toy", length=4).made_by == {
        "env": "Toy", "scale": registry.default_scale(), "kwargs": {"length": 4}
    }  # fmt: skip


def test_environments_can_be_made_in_a_batch():
    moduli = jnp.array([300.0, 700.0])
    batch = jax.vmap(lambda modulus: rewax.make("RollingFlat", scale="small", youngs_modulus=modulus))(moduli)
    np.testing.assert_array_equal(batch.scene.material.elasticity.youngs_modulus, moduli)
    assert batch.rest_positions.shape[0] == 2


def loaded(*steps):
    """Heavy packages in the memory of a new process after each of these pieces of code."""
    say = f"import sys\nprint(*[name for name in {HEAVY} + ('jax',) if name in sys.modules])"
    code = "\n".join(f"{step}\n{say}" for step in steps)
    environment = toys.subprocess_environment()
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return [set(line.split()) for line in done.stdout.splitlines()]


def test_importing_loads_nothing_heavy_and_making_a_task_what_it_needs():
    use_every_name = "for name in rewax.__all__: getattr(rewax, name)\nrewax.list_envs()"
    physics = "from rewax.physics import contact, coupling, mpm, numerics, shapes, tets"
    makes = [f"rewax.make({name!r}, scale='small')" for name in ("RollingFlat", "AntRun", "CartpoleSwingUp")]
    first, names, *made = loaded("import rewax", f"{use_every_name}\n{physics}", *makes)
    assert (first, names) == (set(), {"jax"})
    assert ["mujoco" in found for found in made] == [False, True, True]
    assert not set.union(*made) & {"distrax", "orbax", "matplotlib", "tyro"}


def test_every_name_of_the_package_can_be_reached():
    assert set(rewax.__all__) < set(dir(rewax)) and all(hasattr(rewax, name) for name in rewax.__all__)
    assert rewax.physics.mpm.MPMScene and rewax.testing.check_env
    with pytest.raises(AttributeError, match="module 'rewax' has no attribute 'mke'"):
        _ = rewax.mke
