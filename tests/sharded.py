"""Programs inside ``shard_map`` with its defaults, which checks along which axes values differ."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh


def traced_under_shard_map(function: Callable[..., Any], *args: Any) -> Any:
    """Shapes of what a function of one environment returns for a batch of one, on a mesh of one device.

    Raises:
      TypeError: a loop begins with a value that is the same on all devices and ends with one that differs.
    """
    mesh, spec = Mesh(np.array(jax.devices()[:1]), ("envs",)), jax.P("envs")
    batch = jax.tree.map(lambda a: np.asarray(a)[None], args)
    return jax.eval_shape(jax.shard_map(jax.vmap(function), mesh=mesh, in_specs=spec, out_specs=spec), *batch)
