"""A run of several processes is that of one."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from rewax.training.loop import hosts
from rewax.training.loop.hosts import Command, Leader, connect, leads, num_processes

SCRIPT = Path(__file__).with_name("many_hosts.py")


def start(sharing_programs, *arguments):
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    paths = os.pathsep.join([str(SCRIPT.parent.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**sharing_programs, "DEVICES": "2", "PYTHONPATH": paths}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def said(process):
    try:
        out, errors = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 0, errors[-3000:]
    return out


def test_two_processes_train_as_one_does_and_leave_one_run(tmp_path, sharing_programs, monkeypatch):
    monkeypatch.syspath_prepend(SCRIPT.parent)
    from many_devices import compare, run

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    both = [start(sharing_programs, 2, index, port, tmp_path / "together") for index in range(2)]
    assert ["done" in said(process) for process in both] == [True, True]
    rows = tmp_path / "together" / "metrics.csv"
    assert len(rows.read_text().splitlines()) == 3
    together = run("sapo", 1, tmp_path / "together", resume=True)  # the rest of its four iterations
    compare(together, run("sapo", 1, tmp_path / "alone"))
    assert len(rows.read_text().splitlines()) == 5  # one process went on


def test_alone_it_leads_and_nothing_is_sent():
    leader, tree = Leader(), {"a": jax.numpy.ones(3)}
    leader.step()
    leader.back()
    leader.end()
    assert leads() and leader.hand_out(tree) is tree and leader.gathered(tree) is tree


def test_the_others_return_to_the_state_before_an_iteration(monkeypatch):
    commands = iter([Command.STEP, Command.GATHER, Command.STEP, Command.BACK, Command.GATHER, Command.END])
    sent = []
    monkeypatch.setattr(hosts, "_next_command", lambda: next(commands))
    monkeypatch.setattr(hosts, "_gathered", sent.append)
    assert hosts.follow(lambda state: (state + 1, {}), 0) == 1
    assert sent == [1, 1]


def test_who_the_others_are_has_to_be_said():
    assert num_processes({}) is None and num_processes({"JAX_NUM_PROCESSES": "3"}) == 3
    with pytest.raises(ValueError, match="JAX_NUM_PROCESSES is 'two': set JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES"):
        num_processes({"JAX_NUM_PROCESSES": "two"})
    with pytest.raises(ValueError, match=r"cannot join the other processes \(.*\): set JAX_COORDINATOR_ADDRESS"):
        connect({"JAX_NUM_PROCESSES": "2"})
