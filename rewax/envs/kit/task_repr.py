"""One line about a task: observations, actions, time steps, and the size of the simulation."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.coupling.mixed import MixedScene
from rewax.physics.tets import TetScene
from rewax.physics.thin import ThinScene


def task_repr(task: Any) -> str:
    """Name, recipe of ``rewax.make``, observation, action, control step, sizes and number of parameters of a task."""
    recipe = getattr(task, "made_by", None) or {"kwargs": {}}
    given = {"scale": recipe.get("scale"), **recipe["kwargs"]}
    parts = [f"{name}={value!r}" for name, value in given.items() if value is not None]
    for details in (_specs, _time, _sizes):
        try:
            parts += details(task)
        except Exception:  # a batch of tasks, a tree without arrays, an unfinished task: their text must not raise
            continue
    return f"{type(task).__name__}({', '.join(parts)})"


def num_parameters(env: Any) -> int:
    """How many arrays of an environment hold real numbers: those that ``rewax.envs.randomize.leaves`` lists."""
    return sum(bool(jnp.issubdtype(jnp.result_type(leaf), jnp.floating)) for leaf in jax.tree.leaves(env))


def _specs(task: Any) -> list[str]:
    observation = {name: spec.shape for name, spec in task.observation_spec.items()}
    return [f"observation={observation}", f"action={task.action_spec.shape}"]


def _time(task: Any) -> list[str]:
    steps = f"num_substeps={task.num_substeps}", f"episode_length={task.max_steps}"
    return [f"control_dt={task.control_dt:.6g} s", *steps]


def _sizes(task: Any) -> list[str]:
    """Numbers of particles, or of vertices and elements, of degrees of freedom, and of parameters."""
    sizes, scene, model = [], getattr(task, "scene", None), getattr(task, "model", None)
    if scene is not None:
        num = np.shape(task.rest_positions)[-2]
        sizes = [f"{num} particles"]
        if isinstance(scene, TetScene):
            sizes = [f"{num} vertices", f"{np.shape(scene.tets)[-2]} tets"]
        elif isinstance(scene, ThinScene):
            sizes = _thin_sizes(scene, num)
        elif isinstance(scene, MixedScene):
            vertices = np.shape(scene.thin.mass)[-1]
            sizes = [f"{num - vertices} particles", *_thin_sizes(scene.thin, vertices)]
    if model is not None:
        sizes.append(f"{model.num_dofs} dofs")
    return [*sizes, f"{num_parameters(task)} parameters"]


def _thin_sizes(scene: ThinScene, num: int) -> list[str]:
    counts = {"triangles": len(scene.topology.triangles), "segments": len(scene.topology.segments)}
    return [f"{num} vertices", *(f"{count} {name}" for name, count in counts.items() if count)]


__all__ = ["num_parameters", "task_repr"]
