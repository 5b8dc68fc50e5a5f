"""Processes that train a tiny agent together, and one that compares: ``train COUNT INDEX PORT FOLDER``, ``compare FOLDER``."""

import sys
from pathlib import Path

from many_devices import compare, run

from rewax.training.loop.hosts import connect, leads


def train(count, index, port, folder):
    where = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{port}", "JAX_NUM_PROCESSES": count, "JAX_PROCESS_ID": index}
    connect(where)
    state = run("sapo", 0, folder, iterations=2)
    returns = state.environments.episode_return
    assert len(returns.sharding.device_set) == int(count) * len(returns.addressable_shards) > 1
    try:
        assert run("sapo", 0, folder) is None and not leads()  # those that do not lead are told to leave
    except ValueError as error:
        assert leads() and "holds a run already" in str(error)
    print("done")


def compared(folder):
    together = run("sapo", 1, folder, resume=True)  # the rest of its four iterations
    compare(together, run("sapo", 1, Path(folder).with_name("alone")))
    print("the same in several processes and in one")


if __name__ == "__main__":
    {"train": train, "compare": compared}[sys.argv[1]](*sys.argv[2:])
