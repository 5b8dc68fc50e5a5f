"""Results of identification as environments read them: values, distributions, the recipe that a run records."""

import json

import jax
import numpy as np
import pytest
import toys

import rewax
from rewax.envs import Randomized, registry
from rewax.envs.randomize import LogNormal, Normal, Scale, Shift, identified
from rewax.envs.randomize.stored import FORMAT, change_of, draws_of, part_for_environments, told, with_result

DRAWS = {
    "gain": LogNormal(0.3, 0.2, low=0.1, high=0.9),
    "shift": Shift(Normal(0.0, 1.0)),
    "by": Scale(Normal(1.0, 0.1)),
}


def entries(draws):
    return [{"names": [name], "change": change_of(d), "posterior": told(d)} for name, d in draws.items()]


def test_distributions_survive_as_plain_numbers():
    again = draws_of(json.loads(json.dumps(entries(DRAWS))))
    assert again.draws == tuple(((name,), draw) for name, draw in DRAWS.items())


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setitem(registry._FACTORIES, "PointMass", lambda scale: toys.point_mass())
    path = tmp_path / "found.json"
    found = {"format": FORMAT, "made_by": None, "values": {"gain": 0.3, "initial.velocity[0]": 1.0}}
    path.write_text(json.dumps({**found, "unknowns": entries({"gain": DRAWS["gain"]})}))
    return path


def test_make_gives_the_values_found_and_remembers_them_without_the_file(file):
    env = rewax.make("PointMass", scale="small", identified=file)
    assert env.gain == np.float32(0.3)
    recipe = json.loads(json.dumps(env.made_by))
    file.unlink()
    again = rewax.make(recipe["env"], scale=recipe["scale"], **recipe["kwargs"])
    assert again.gain == env.gain and again.made_by == env.made_by


def test_the_distribution_is_drawn_at_every_reset(file):
    hook = identified(file)
    env = with_result(toys.point_mass(), part_for_environments(file, "draws"))
    assert isinstance(env, Randomized) and env.randomize == hook
    keys = jax.random.split(jax.random.key(0), 400)
    gains = np.asarray(jax.vmap(lambda key: hook(key, toys.point_mass()).gain)(keys))
    assert np.median(gains) == pytest.approx(0.3, rel=0.03) and np.log(gains).std() == pytest.approx(0.2, rel=0.1)


def test_what_is_no_result_is_refused(file):
    with pytest.raises(ValueError, match=r"there is no result 'absent.json'"):
        rewax.make("PointMass", identified="absent.json")
    with pytest.raises(ValueError, match=r"lacks values or unknowns"):
        rewax.make("PointMass", identified={"values": {}})
    with pytest.raises(ValueError, match=r"use of identified is 'mean': give one of 'values', 'draws'"):
        rewax.make("PointMass", identified={**part_for_environments(file), "use": "mean"})
    with pytest.raises(ValueError, match=r"RollingFlat has no parameter 'gain'"):
        rewax.make("RollingFlat", scale="small", identified=file)
