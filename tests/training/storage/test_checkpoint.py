"""A checkpoint is whole, bit-exact, and says clearly what is wrong with it."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

from rewax.training.storage import checkpoint


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


def test_a_process_killed_while_writing_leaves_the_previous_one(tmp_path, sharing_programs):
    script = textwrap.dedent("""
        import os, signal, sys
        import jax, numpy as np, toys
        import orbax.checkpoint as ocp
        from rewax.training.storage import checkpoint
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
    environment = {**sharing_programs, **toys.subprocess_environment()}
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], env=environment, timeout=300)
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
    if damage in ("entry", "value"):  # of a checkpoint of an earlier version, which has no checksum of leaves.json
        (path / "checksums.json").unlink()
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


STRAY = {
    "a hidden file": lambda folder: (folder / ".DS_Store").write_text("x"),
    "a folder with a number": lambda folder: (folder / "9").mkdir(),
    "a file with a number": lambda folder: (folder / "9").write_text("x"),
    "a padded number": lambda folder: (folder / "09" / "arrays").mkdir(parents=True),
    "a hidden folder": lambda folder: (folder / ".trash").mkdir(),
    "in the way": lambda folder: ((folder / "2").mkdir(), (folder / "2" / "notes.txt").write_text("x")),
    "a file in the way": lambda folder: (folder / "2").write_text("x"),
}


@pytest.mark.parametrize("what", STRAY)
def test_stray_files_are_ignored_and_stay(tmp_path, what):
    agent, state = advanced(1)
    checkpoint.save(tmp_path, state)
    STRAY[what](tmp_path / "checkpoints")
    strays = {path.name for path in (tmp_path / "checkpoints").iterdir()} - {"1"}
    assert checkpoint.latest_step(tmp_path) == 1
    assert same_bits(checkpoint.restore(tmp_path, state), state)
    later, _ = agent.train_step(state)
    checkpoint.save(tmp_path, later)
    assert same_bits(checkpoint.restore(tmp_path, state), later)
    there = {path.name for path in (tmp_path / "checkpoints").iterdir()} - {"1", "2"}
    assert there == {"2.stray" if name == "2" else name for name in strays}


def damage(path):
    """Cut the description short."""
    leaves = path / "leaves.json"
    leaves.write_text(leaves.read_text()[:100])


def three(run_dir):
    """Checkpoints of iterations 1, 2 and 3, and the states in them."""
    agent, state = advanced(1)
    states = [state]
    for _ in range(2):
        states.append(agent.train_step(states[-1])[0])
    return states, [checkpoint.save(run_dir, state) for state in states]


def test_damage_falls_back_to_the_checkpoint_before_it(tmp_path):
    states, paths = three(tmp_path)
    damage(paths[2])
    with pytest.warns(UserWarning, match=r"checkpoints/3 is damaged .*: using the one of iteration 2 before it$"):
        assert same_bits(checkpoint.restore(tmp_path, states[0]), states[1])
    assert checkpoint.steps(tmp_path) == [1, 2, 3]  # a reader moves nothing
    (paths[1] / "leaves.json").unlink()
    said = []
    assert same_bits(checkpoint.restore(tmp_path, states[0], set_aside=True, notify=said.append), states[0])
    assert [sentence.count("before it; it is kept as") for sentence in said] == [1, 1]
    assert checkpoint.steps(tmp_path) == [1]
    assert (tmp_path / "checkpoints" / "3.damaged" / "arrays").is_dir()
    assert (tmp_path / "checkpoints" / "2.damaged" / "arrays").is_dir()
    with pytest.raises(ValueError, match="no checkpoint of iteration 3: choose one of 1"):
        checkpoint.restore(tmp_path, states[0], step=3)


@pytest.mark.parametrize(
    "error",
    [
        OSError(24, "Too many open files"),
        MemoryError("no room"),
        ValueError("Orbax:\n" + "x" * 300 + " RESOURCE_EXHAUSTED: Out of memory"),
    ],
    ids=["files", "memory", "device"],
)
@pytest.mark.parametrize("what", ["arrays", "leaves.json"])
def test_a_machine_that_fails_leaves_the_checkpoint_in_place(tmp_path, monkeypatch, error, what):
    states, _ = three(tmp_path)

    def fails(*args, **kwargs):
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(*((checkpoint, "_checkpointer") if what == "arrays" else (Path, "read_bytes")), fails)
        with pytest.raises(checkpoint.Unread, match=r"checkpoints/3 could not be read now \(.*: remove the cause"):
            checkpoint.restore(tmp_path, states[0], set_aside=True)
    assert checkpoint.steps(tmp_path) == [1, 2, 3]
    assert same_bits(checkpoint.restore(tmp_path, states[0], set_aside=True), states[2])


def test_a_run_that_goes_on_meanwhile_is_not_damaged(tmp_path, monkeypatch):
    states, _ = three(tmp_path)
    read, wanted = checkpoint._read, [2, 1]

    def after_the_next_ones(path, *rest):  # the process that trains keeps one checkpoint, and saves two more first
        while wanted:
            checkpoint.save(tmp_path, states[-1].replace(iteration=states[-1].iteration + wanted.pop()), keep=1)
        return read(path, *rest)

    monkeypatch.setattr(checkpoint, "_read", after_the_next_ones)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert int(checkpoint.restore(tmp_path, states[0]).iteration) == 5


def test_a_changed_letter_in_the_description_is_damage_and_not_another_configuration(tmp_path):
    states, paths = three(tmp_path)
    leaves = paths[2] / "leaves.json"
    leaves.write_text(leaves.read_text().replace(".bias", ".bios"))
    with pytest.warns(
        UserWarning, match=r"checkpoints/3 is damaged .*leaves\.json does not have its checksum.* iteration 2"
    ):
        assert same_bits(checkpoint.restore(tmp_path, states[0]), states[1])
    (paths[1] / "checksums.json").unlink()
    assert same_bits(checkpoint.restore(tmp_path, states[0], step=2), states[1])  # as earlier versions wrote it


def test_a_checkpoint_asked_for_is_that_one_or_an_error(tmp_path):
    states, paths = three(tmp_path)
    damage(paths[1])
    with pytest.raises(checkpoint.DamagedCheckpoint, match="checkpoints/2 is damaged"):
        checkpoint.restore(tmp_path, states[0], step=2)
    assert same_bits(checkpoint.restore(tmp_path, states[0]), states[2])


def test_if_all_are_damaged_nothing_is_moved(tmp_path):
    states, paths = three(tmp_path)
    for path in paths:
        damage(path)
    with pytest.raises(checkpoint.DamagedCheckpoint, match="checkpoints/3 is damaged and cannot be read"):
        checkpoint.restore(tmp_path, states[0], set_aside=True)
    assert checkpoint.steps(tmp_path) == [1, 2, 3]


def test_another_structure_is_no_damage(tmp_path):
    states, _ = three(tmp_path)
    with pytest.raises(checkpoint.OtherStructure):
        checkpoint.restore(tmp_path, states[0].replace(bias=jnp.zeros(3)), set_aside=True)
    assert checkpoint.steps(tmp_path) == [1, 2, 3]


def test_a_protected_checkpoint_stays(tmp_path):
    agent, state = advanced(0)
    for _ in range(5):
        state, _ = agent.train_step(state)
        checkpoint.save(tmp_path, state, keep=2, protect=2)
    assert checkpoint.steps(tmp_path) == [2, 4, 5]


def test_the_last_healthy_checkpoint_is_known_to_the_next_process(tmp_path):
    assert checkpoint.healthy_step(tmp_path) is None
    three(tmp_path)
    assert checkpoint.healthy_step(tmp_path) == 3
    checkpoint.write_healthy(tmp_path, 2)
    assert checkpoint.healthy_step(tmp_path) == 2 and checkpoint.steps(tmp_path) == [1, 2, 3]
    checkpoint.write_healthy(tmp_path, 9)  # it was removed since
    assert checkpoint.healthy_step(tmp_path) == 3
