"""Placement of a training state: its environments, or the seeds of several runs, are sharded over devices."""

import dataclasses
from typing import Any, ClassVar

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from rewax.agents.devices import AXIS, mesh_of
from rewax.agents.replay import Replay
from rewax.training.storage.leaves import is_key, to_numpy

_SEEDS = "seeds"


@dataclasses.dataclass(frozen=True)
class Placement:
    """Devices of a run: environments and their steps in a replay buffer are sharded, everything else is replicated.

    Attributes:
      mesh: None for one device.
    """

    what: ClassVar[str] = "environments"
    mesh: Mesh | None

    @property
    def num_devices(self) -> int:
        return 1 if self.mesh is None else self.mesh.size

    def shards(self, train_state: Any) -> bool:
        """Whether this state is sharded: a user's algorithm may have a state without ``environments``."""
        return self.mesh is not None and hasattr(train_state, "environments")

    def place(self, train_state: Any) -> Any:
        """The training state on the devices of the mesh."""
        if not self.shards(train_state):
            return train_state
        shardings = self.shardings(train_state)
        # On a CPU slices of NumPy arrays need no program, while `device_put` compiles one for each shape.
        if jax.process_count() == 1 and jax.default_backend() != "cpu":
            return jax.device_put(train_state, shardings)
        return jax.tree.map(_own_part, train_state, shardings)

    def shardings(self, train_state: Any) -> Any:
        """The sharding of each leaf of a training state."""
        assert self.mesh is not None
        axes = ((), (AXIS,), (None, AXIS))
        replicated, sharded, ring = (NamedSharding(self.mesh, PartitionSpec(*axis)) for axis in axes)

        def all_of(tree: Any, sharding: NamedSharding) -> Any:
            return jax.tree.map(lambda _: sharding, tree)

        def shared(part: Any) -> Any:
            """The sharding of a part of the state that is no environment."""
            if _is_replay(part):
                return part.replace(steps=all_of(part.steps, ring), count=replicated)
            return replicated

        environments = train_state.environments
        env = all_of(environments.env, replicated if environments.env.axis is None else sharded)
        own = {"state": all_of(environments.state, sharded), "episode_return": sharded, "env": env}
        shardings = jax.tree.map(shared, train_state, is_leaf=_is_replay)
        return shardings.replace(environments=all_of(environments, replicated).replace(**own))

    def lowered(self, train_step: Any, train_state: Any, *, donate: bool = False) -> jax.stages.Lowered:
        """Lower ``train_step`` for a placed state; the returned state has the same placement."""
        if self.mesh is None or not self.shards(train_state):
            return (train_step if hasattr(train_step, "lower") else jax.jit(train_step)).lower(train_state)
        out = (self.shardings(train_state), None)
        placed = jax.jit(lambda state: train_step(state), out_shardings=out, donate_argnums=0 if donate else ())
        with jax.set_mesh(self.mesh):
            return placed.lower(train_state)


@dataclasses.dataclass(frozen=True)
class SeedPlacement(Placement):
    """Devices of several runs in one program: each device computes some of the seeds, the leading axis of all arrays.

    Attributes:
      mesh: None for one device.
    """

    what: ClassVar[str] = "seeds"

    def shards(self, train_state: Any) -> bool:
        """Whether there are several devices."""
        return self.mesh is not None

    def shardings(self, train_state: Any) -> Any:
        """The sharding of each leaf of the stacked training states."""
        assert self.mesh is not None
        sharding = NamedSharding(self.mesh, PartitionSpec(_SEEDS))
        return jax.tree.map(lambda _: sharding, train_state)

    def lowered(self, train_step: Any, train_state: Any, *, donate: bool = False) -> jax.stages.Lowered:
        """Lower ``train_step``, a function of stacked states, for placed states."""
        donated = 0 if donate else ()
        if self.mesh is None:
            return jax.jit(train_step, donate_argnums=donated).lower(train_state)
        spec = PartitionSpec(_SEEDS)
        step = jax.shard_map(train_step, mesh=self.mesh, in_specs=spec, out_specs=spec, check_vma=False)
        out = (self.shardings(train_state), None)  # without it an empty array would come back without its sharding
        return jax.jit(step, out_shardings=out, donate_argnums=donated).lower(train_state)

    def parts(self, tree: Any) -> list[Any]:
        """The arrays that each device holds, in the order of the seeds."""
        if self.mesh is None:
            return [tree]
        leaves, structure = jax.tree.flatten(tree)
        shards = [sorted(leaf.addressable_shards, key=lambda shard: shard.index[0].start or 0) for leaf in leaves]
        return [structure.unflatten([one.data for one in part]) for part in zip(*shards, strict=True)]


def _own_part(leaf: Any, sharding: NamedSharding) -> Any:
    """This process's shard of an array that every process has in full."""
    numbers = to_numpy(leaf)
    array = jax.make_array_from_callback(numbers.shape, sharding, lambda part: numbers[part])
    return jax.random.wrap_key_data(array, impl=str(jax.random.key_impl(leaf))) if is_key(leaf) else array


ONE_DEVICE = Placement(None)


def placement(num_envs: int | None, wanted: int) -> Placement:
    """The placement for a number of environments.

    Args:
      num_envs: number of environments; None: the algorithm does not have one, and one device is used.
      wanted: number of devices; 0: the largest number of JAX's devices that divides the environments.

    Raises:
      ValueError: there are fewer devices, or they do not divide the environments.
    """
    devices, count = jax.devices(), _count(num_envs, wanted, "num_envs")
    if jax.process_count() > 1 and count != len(devices):
        raise ValueError(
            f"{jax.process_count()} processes have {len(devices)} devices, which do not divide num_envs {num_envs} or "
            f"are not the {wanted or count} asked for: give --devices 0 and a multiple of {len(devices)} environments"
        )
    return Placement(None if count == 1 else mesh_of(devices[:count]))


def seed_placement(num_seeds: int, wanted: int) -> SeedPlacement:
    """The placement of several runs in one program; errors as for ``placement``."""
    count = _count(num_seeds, wanted, "num_seeds")
    return SeedPlacement(None if count == 1 else mesh_of(jax.devices()[:count], _SEEDS))


def _count(parts: int | None, wanted: int, name: str) -> int:
    """Number of devices for a number of equal parts; None: the parts are unknown."""
    devices = jax.devices()
    if wanted > len(devices):
        kind = devices[0].platform
        remedy = "; on a CPU set jax_num_cpu_devices before JAX computes anything" if kind == "cpu" else ""
        raise ValueError(f"devices is {wanted}, but JAX has {len(devices)} ({kind}): ask for that many at most{remedy}")
    if wanted > 1 and (parts is None or parts % wanted):
        raise ValueError(f"devices is {wanted}, which does not divide {name} {parts}: give a divisor of it, or 1")
    most = 1 if parts is None else len(devices)
    return wanted or max(n for n in range(1, most + 1) if n == 1 or (parts or 0) % n == 0)


def on_one_device(tree: Any) -> Any:
    """The arrays on one of the devices that hold them, for programs that are not sharded.

    Of a sharded replay buffer, which no such program reads, it is one shard, because the whole may not fit. Of
    environments that are sharded over several processes it is this process's shard.
    """
    arrays = [leaf for leaf in jax.tree.leaves(tree) if isinstance(leaf, jax.Array)]
    if not all(array.is_fully_addressable for array in arrays):
        return _first_shard(tree)
    devices = next((array.devices() for array in arrays), set())
    if len(devices) <= 1:
        return tree
    first = min(devices, key=lambda device: device.id)
    tree = jax.tree.map(lambda part: _first_shard(part) if _is_replay(part) else part, tree, is_leaf=_is_replay)
    return jax.device_put(tree, first)


def _first_shard(tree: Any) -> Any:
    return jax.tree.map(lambda a: a.addressable_data(0) if isinstance(a, jax.Array) else a, tree)


def _is_replay(part: Any) -> bool:
    return isinstance(part, Replay)


__all__ = ["ONE_DEVICE", "Placement", "SeedPlacement", "on_one_device", "placement", "seed_placement"]
