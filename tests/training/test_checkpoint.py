"""A checkpoint is whole, bit-exact, and says clearly what is wrong with it."""

import json
import os
import signal
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax.training import checkpoint


def advanced(num_iterations=2, **kwargs):
    """A toy agent and its state after a few iterations."""
    agent = toys.make_toy(toys.point_mass(), **kwargs)
    state = agent.init(jax.random.key(0))
    for _ in range(num_iterations):
        state, _ = agent.train_step(state)
    return agent, state


def same_bits(a, b):
    """Trees agree in structure, types and every bit, keys and NaN included."""
    if jax.tree.structure(a) != jax.tree.structure(b):
        return False

    def data(leaf):
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if is_key else leaf)

    pairs = [
        (x.dtype == y.dtype, data(x), data(y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    ]
    return all(same and x.shape == y.shape and x.tobytes() == y.tobytes() for same, x, y in pairs)


def test_restores_every_bit(tmp_path):
    _agent, state = advanced()
    state = state.replace(bias=jnp.array([jnp.nan, -0.0, 1e-42], jnp.float32))
    checkpoint.save(tmp_path, state)
    for like in (state, jax.eval_shape(lambda: state)):
        assert same_bits(checkpoint.restore(tmp_path, like), state)
    assert not same_bits(state, state.replace(bias=jnp.zeros(3)))


def test_restores_other_dtypes_and_key_kinds(tmp_path):
    _, state = advanced()
    state = state.replace(
        bias=jnp.array([1.5], jnp.bfloat16), memory=jnp.array([True, False]), key=jax.random.key(3, impl="rbg")
    )
    checkpoint.save(tmp_path, state)
    restored = checkpoint.restore(tmp_path, state)
    assert same_bits(restored, state)
    assert jax.random.key_impl(restored.key) == jax.random.key_impl(state.key)


def test_keeps_the_latest(tmp_path):
    agent, state = advanced(0)
    assert checkpoint.latest_step(tmp_path) is None
    for _ in range(4):
        state, _ = agent.train_step(state)
        checkpoint.save(tmp_path, state, keep=2)
    assert sorted(os.listdir(tmp_path / "checkpoints")) == ["3", "4"]
    assert checkpoint.latest_step(tmp_path) == 4
    assert int(checkpoint.restore(tmp_path, state, step=3).iteration) == 3


def test_an_unfinished_checkpoint_is_not_seen_and_later_removed(tmp_path):
    agent, state = advanced(1)
    checkpoint.save(tmp_path, state)
    unfinished = tmp_path / "checkpoints" / ".writing-9"
    (unfinished / "arrays").mkdir(parents=True)
    assert checkpoint.latest_step(tmp_path) == 1
    assert same_bits(checkpoint.restore(tmp_path, state), state)
    state, _ = agent.train_step(state)
    checkpoint.save(tmp_path, state)
    assert not unfinished.exists()


def test_a_process_killed_while_writing_leaves_the_previous_one(tmp_path):
    script = textwrap.dedent("""
        import os, signal, sys
        import jax, numpy as np, toys
        import orbax.checkpoint as ocp
        from rewax.training import checkpoint
        agent = toys.make_toy(toys.point_mass())
        state = agent.init(jax.random.key(0))
        checkpoint.save(sys.argv[1], state)
        write = ocp.Checkpointer.save
        def die_after(*args, **kwargs):
            write(*args, **kwargs)
            os.kill(os.getpid(), signal.SIGKILL)
        ocp.Checkpointer.save = die_after
        checkpoint.save(sys.argv[1], agent.train_step(state)[0])
    """)
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], env=toys.subprocess_environment(), timeout=300)
    assert done.returncode == -signal.SIGKILL
    assert (tmp_path / "checkpoints" / ".writing-1").is_dir()
    assert checkpoint.latest_step(tmp_path) == 0
    agent = toys.make_toy(toys.point_mass())
    assert same_bits(checkpoint.restore(tmp_path, agent.init(jax.random.key(0))), agent.init(jax.random.key(0)))


def fails(run_dir, like, *words):
    """restore raises ValueError with one sentence that holds the words."""
    with pytest.raises(ValueError) as caught:
        checkpoint.restore(run_dir, like)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_missing_directory_and_missing_checkpoint(tmp_path):
    _, state = advanced(0)
    fails(tmp_path / "nowhere", state, "there is no run directory", "nowhere")
    fails(tmp_path, state, "holds no complete checkpoint")
    (tmp_path / "checkpoints" / ".writing-3").mkdir(parents=True)
    fails(tmp_path, state, "holds no complete checkpoint")


def test_another_configuration_names_the_field(tmp_path):
    _agent, state = advanced(0)
    checkpoint.save(tmp_path, state)
    wider = toys.make_toy(toys.point_mass(), width=3).init(jax.random.key(0))
    fails(tmp_path, wider, ".bias", "(1,)", "(3,)")
    fails(tmp_path, toys.make_toy(toys.point_mass(), num_envs=2).init(jax.random.key(0)), ".envs.", "(4,", "(2,")
    fails(tmp_path, state.replace(bias=state.bias.astype(jnp.float16)), ".bias", "float32", "float16")
    fails(tmp_path, state.replace(key=jax.random.key(0, impl="rbg")), ".key", "fry", "rbg")
    fails(tmp_path, state.replace(memory={"more": state.memory}), ".memory")


@pytest.mark.parametrize("damage", ["description", "entry", "arrays", "value"])
def test_damage_is_noticed(tmp_path, damage):
    _, state = advanced(1)
    path = checkpoint.save(tmp_path, state)
    leaves = path / "leaves.json"
    if damage == "description":
        leaves.write_text(leaves.read_text()[:100])
    elif damage == "entry":
        leaves.write_text(json.dumps({name: {} for name in json.loads(leaves.read_text())}))
    elif damage == "arrays":
        for file in (path / "arrays").rglob("*"):
            if file.is_file():
                file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    else:
        entries = json.loads(leaves.read_text())
        entries[".bias"]["crc32"] ^= 1
        leaves.write_text(json.dumps(entries))
    fails(tmp_path, state, "damaged and cannot be read", str(path))


def test_configuration_is_kept(tmp_path):
    checkpoint.write_config(tmp_path, {"env": "PointMass", "sizes": (1, 2), "rate": 0.5})
    config = checkpoint.read_config(tmp_path)
    assert {name: config[name] for name in ("env", "sizes", "rate")} == {
        "env": "PointMass",
        "sizes": [1, 2],
        "rate": 0.5,
    }
    assert config["versions"]["jax"] == jax.__version__
    assert checkpoint.read_config(tmp_path / "nowhere") == {}
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ValueError, match="not readable as JSON"):
        checkpoint.read_config(tmp_path)
