"""One of several processes that train a tiny agent together: ``COUNT INDEX PORT FOLDER``."""

import sys

from many_devices import run

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


if __name__ == "__main__":
    train(*sys.argv[1:])
