"""What of each task runs in C++: an operation that has no place there would be slow without a word."""

from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
import toys
from jax.sharding import PartitionSpec
from native_cases import NEEDS_COMPILER

from rewax import struct
from rewax.agents.devices import AXIS, mesh_of
from rewax.cli.main import main
from rewax.envs import list_envs, make, registry
from rewax.lowering import interpreted, recorded
from rewax.testing import where_it_runs

RULES = ("value", "tangent", "cotangent")
SOFT = {"mpm.stepping._moved", "mpm.stepping.stress_and_momentum"}
TOOL = SOFT | {"contact.colliders.velocity_after"}
RIGID = {"rigid.stepping._accelerate"}
TETS = {"contact.penalty._ground_force", "tets.stepping._columns.columns", "tets.stepping._moved"}
SHELL = {
    "thin.elements._hinge_pull", "thin.elements._hinge_turn", "thin.elements._membrane.membrane", "thin.plate._moment",
    "thin.stepping._moved",
}  # fmt: skip
CLOTH = SHELL | {"contact.penalty._ground_force", "thin.grasp_forces._followed", "thin.grasp_forces._pull"}
GRAINS = SOFT | {"coupling.nodes._after", "coupling.nodes._met", "coupling.particle_contact.pair_force"}
FUNCTIONS = {
    **dict.fromkeys(["FluidMove", "HandFlip", "HandLift", "RollingFlat", "SteerFloat"], TOOL),
    **dict.fromkeys(
        ["Ant", "AntRun", "CartpoleSwingUp", "HalfCheetah", "HandReorient", "Hopper", "Humanoid", "Quadruped"], RIGID
    ),
    "GripperLift": SOFT | RIGID | {"coupling.nodes._after", "coupling.nodes._met", "coupling.nodes._weights"},
    "SoftJumper": TETS,
    "SoftJumperMPM": SOFT,
    "WhipRope": {"thin.elements._bend", "thin.elements._segment", "thin.stepping._moved"},
    "CoverBox": CLOTH | {"contact.penalty._collider_force"},
    "FoldCloth": CLOTH,
    "PourBag": GRAINS | SHELL,
}
"""The functions of each task's physics, within ``rewax.physics``."""
SELF_CONTACT = {("FoldCloth", "paper"): {"thin.pair_law.segments_force", "thin.pair_law.vertex_triangle_force"}}
"""Functions besides of a task at a scale: cloth that touches itself."""
LEFT: dict[tuple[str, str, str], str] = {}
"""What is left to XLA."""
QUICK = {"RollingFlat", "SoftJumper"}
"""Tasks whose paper scale is looked at in every run of the tests; that of the others differs from small in sizes alone."""
LONG = {
    "Ant", "AntRun", "FluidMove", "FoldCloth", "HalfCheetah", "HandFlip", "HandLift", "HandReorient", "Humanoid",
    "Quadruped", "SoftJumperMPM", "SteerFloat",
}  # fmt: skip
"""Tasks that only `pytest -m slow` looks at: others have the same functions."""


def test_every_task_is_listed():
    pages = {page.stem for page in (Path(__file__).parents[1] / "docs" / "tasks").glob("*.md")} - {"index"}
    assert set(FUNCTIONS) == pages and pages <= set(list_envs())


@NEEDS_COMPILER
@pytest.mark.parametrize(
    ("task", "scale"),
    [
        pytest.param(
            task, scale, marks=[pytest.mark.slow] if (task in LONG or (scale == "paper" and task not in QUICK)) else []
        )
        for task in FUNCTIONS
        for scale in ("small", "paper")
    ],
)
def test_what_runs_in_cpp(task, scale):
    found = {
        (d.function.removeprefix("rewax.physics."), d.rule): d.reason for d in where_it_runs(make(task, scale=scale))
    }
    functions = FUNCTIONS[task] | SELF_CONTACT.get((task, scale), set())
    expected = {(function, rule): LEFT.get((task, function, rule)) for function in functions for rule in RULES}
    assert found == expected


@NEEDS_COMPILER
@pytest.mark.parametrize("task", ["CartpoleSwingUp", "RollingFlat"])
def test_where_environments_are_sharded_over_devices(task):
    env = make(task, scale="small")
    states = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 2))
    spec = PartitionSpec(AXIS)

    def gradient(action, state):
        return jax.grad(lambda action: env.step(state, action).reward)(action)

    with jax.set_mesh(mesh_of(jax.devices()[:1])), recorded() as decisions:
        own = jax.shard_map(jax.vmap(gradient), in_specs=(spec, spec), out_specs=spec, check_vma=False)
        jax.jit(own).lower(jnp.zeros((2, *env.action_spec.shape)), states)
    assert {d.rule for d in decisions} >= {"value", "cotangent"} and not [d for d in decisions if d.reason]


@struct.dataclass
class Sorting(toys.PointMass):
    """Its dynamics has an operation that cannot be lowered."""

    def step(self, state, action):
        return self.after(state, interpreted(lambda x, a: jnp.sort(x + jnp.clip(a, -1.0, 1.0)))(state.physics, action))


@struct.dataclass
class Tuned(toys.PointMass):
    """Its parameter alone enters a function."""

    def step(self, state, action):
        return self.after(state, state.physics + action * interpreted(jnp.sin)(self.gain))


@NEEDS_COMPILER
def test_the_forward_derivative_by_a_parameter_is_lowered_too():
    found = where_it_runs(Tuned(gain=jnp.float32(0.5)))
    assert [(d.rule, d.reason) for d in found] == [(rule, None) for rule in sorted(RULES)]


@NEEDS_COMPILER
def test_users_see_what_is_left_to_xla_in_their_own_task(capsys):
    registry._FACTORIES["Sorting"] = lambda scale: Sorting(gain=jnp.float32(0.5))
    try:
        assert main(["check", "--env", "Sorting", "--no-whole-episode", "--in-cpp"]) == 1
        assert "the value: XLA, for it has the operation sort" in capsys.readouterr().err
        main(["doctor", "--env", "Sorting"])
        said = capsys.readouterr().out
        assert "Sorting at scale small: 0 rules run in C++" in said and "the value: XLA, for it has" in said
    finally:
        del registry._FACTORIES["Sorting"]
