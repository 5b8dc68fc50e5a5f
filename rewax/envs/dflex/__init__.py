"""The dflex suite: the tasks of DiffRL (Xu et al. 2022), with its observations, rewards and terminations."""
