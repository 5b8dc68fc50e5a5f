"""A run on several devices is that on one."""

import subprocess
import sys
from pathlib import Path

import jax
import pytest

from rewax.training.loop.devices import ONE_DEVICE, Placement, on_one_device, placement, seed_placement


@pytest.mark.parametrize(
    "names", [["sapo"], pytest.param(["ppo", "sac", "trajopt", "apg", "shac", "ahac", "rpo"], marks=pytest.mark.slow)]
)
def test_several_devices_train_as_one_does(names, sharing_programs):
    script = Path(__file__).with_name("many_devices.py")
    environment = {**sharing_programs, "DEVICES": "8"}
    done = subprocess.run([sys.executable, str(script), *names], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "the same on one and on several devices" in done.stdout


def test_what_cannot_be_sharded_is_refused():
    with pytest.raises(ValueError, match=r"devices is 7, but JAX has 1 \(cpu\): ask for that many at most"):
        placement(8, 7)
    with pytest.raises(ValueError, match=r"devices is 2, but JAX has 1 \(cpu\)"):
        seed_placement(4, 2)
    assert placement(8, 0) == placement(None, 0) == ONE_DEVICE
    assert not Placement(mesh=object()).shards({"iteration": 0})  # an algorithm of one's own, without environments
    tree = {"a": jax.numpy.ones(3)}
    assert on_one_device(tree) is tree and ONE_DEVICE.place(tree) is tree
