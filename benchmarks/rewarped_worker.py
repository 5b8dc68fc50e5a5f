"""Rewarped's ant behind two pipes, for ``ant_in_rewarped.py``: ``rewarped_worker.py EPISODES EVERY SEED``.

Needs rewarped, torch and gym, not rewax. EVERY is the number of substeps for which a mass matrix is kept. Writes the
first observations, (episodes, 37) numbers in single precision. Then, for each step: reads actions, (episodes, 8), and
writes rewards and ends of episodes, (2, episodes), and observations.
"""

import os
import sys

import numpy as np


def main(episodes: int, every: int, seed: int) -> int:
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # Warp prints to stdout
    import torch
    from rewarped.envs.dflex.ant import Ant

    torch.manual_seed(seed)
    Ant.featherstone_settings = {**Ant.featherstone_settings, "update_mass_matrix_every": every}
    ant = Ant(num_envs=episodes, device="cpu", no_grad=True, use_graph_capture=False, no_env_offset=True)
    write(out, ant.reset().numpy())
    for _ in range(ant.episode_length):
        actions = np.frombuffer(sys.stdin.buffer.read(episodes * ant.num_actions * 4), np.float32)
        actions = torch.from_numpy(actions.reshape(episodes, ant.num_actions).copy())
        obs, reward, ended, _ = ant.step(actions)
        write(out, np.stack([reward.numpy(), ended.numpy()]))
        write(out, obs.numpy())
    return 0


def write(out, array: np.ndarray) -> None:
    out.write(np.ascontiguousarray(array, np.float32).tobytes())
    out.flush()


if __name__ == "__main__":
    raise SystemExit(main(*map(int, sys.argv[1:])))
