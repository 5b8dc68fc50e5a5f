"""A trained policy in NumPy alone: it needs this file and the file ``weights.npz`` beside it, and not rewax.

policy = NumpyPolicy("weights.npz")
action = policy(observation)                    # a dict of arrays of one environment; deterministic
action = policy(observation, noise)             # noise: standard normal numbers, one per action component

A policy with memory takes and returns it:

memory = policy.initial_memory()                # at the first step of an episode
action, memory = policy(observation, memory=memory)
"""

import json

import numpy as np

ACTIVATIONS = {
    "silu": lambda x: x / (1.0 + np.exp(-x)),
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
}


class NumpyPolicy:
    """A function from an observation to an action.

    Args:
      path: the file ``weights.npz`` that ``rewax export`` wrote.

    Attributes:
      describes: dict with the task, the algorithm, the iteration, ``observation`` (the shape of each array that the
        policy needs, by name), ``action_size``, and ``memory``, the size of the policy's memory, 0 for none.
    """

    def __init__(self, path):
        with np.load(path) as file:
            self.weights = {name: file[name] for name in file.files}
        self.describes = json.loads(str(self.weights.pop("describes")))
        self.activation = ACTIVATIONS[self.describes["activation"]]

    def initial_memory(self):
        """The memory at the first step of an episode: zeros; None if the policy has none."""
        return np.zeros(self._size, np.float32) if self._size else None

    def __call__(self, observation, noise=0.0, memory=None):
        """The action tanh(mean + std * noise), shape (action_size,), within [-1, 1]; with memory, (action, memory).

        Args:
          observation: arrays by name, those of one environment; further names are ignored.
          noise: 0 for the deterministic action, or standard normal numbers of shape (action_size,) for a sampled one.
          memory: what the policy returned at the step before; at the first step of an episode ``initial_memory()``.

        Raises:
          ValueError: an array is missing or has another shape than ``describes["observation"]`` says.
        """
        self._check(observation)
        self._check_memory(memory)
        seen, features = self._normalized(observation), []
        for name in sorted(seen):
            if seen[name].ndim == 2:
                points = self._layers(f"encoder/points_{name}/", seen[name])
                features.append(self._layer(f"encoder/pooled_{name}/", points.mean(axis=0)))
            elif seen[name].ndim == 3:
                features.append(self._picture(f"encoder/picture_{name}/", seen[name]))
        vectors = [seen[name].reshape(-1) for name in sorted(seen) if seen[name].ndim not in (2, 3)]
        if vectors:
            joined = np.concatenate(vectors)
            whole = "encoder/vectors/Dense_0/kernel" not in self.weights
            features.append(joined if whole else self._layer("encoder/vectors/", joined))
        x = np.concatenate(features)
        if self._size:
            memory = self._remember(x, memory)
            x = np.concatenate([x, memory])
        x = self._layers("MLP_0/", x)
        log_std = self.weights["log_std"] if "log_std" in self.weights else self._linear("log_std/", x)
        std = np.exp(np.clip(log_std, *self.describes["log_std_range"]))
        action = np.tanh(self._linear("mean/", x) + std * noise)
        return (action, memory) if self._size else action

    @property
    def _size(self):
        return self.describes.get("memory", 0)

    def _remember(self, x, memory):
        """A gated recurrent unit."""
        keep, reset, new = np.split(self._linear("memory/input/", x), 3)
        old_keep, old_reset, old_new = np.split(self._linear("memory/recurrent/", np.asarray(memory, np.float32)), 3)
        keep = 1.0 / (1.0 + np.exp(-(keep + old_keep)))
        new = np.tanh(new + old_new / (1.0 + np.exp(-(reset + old_reset))))
        return keep * memory + (1.0 - keep) * new

    def _check(self, observation):
        expected = {name: tuple(shape) for name, shape in self.describes["observation"].items()}
        if not isinstance(observation, dict):
            kind = type(observation).__name__
            raise ValueError(f"the observation is a {kind}: give a dict of arrays, one for each name of {expected}")
        for name, shape in expected.items():
            if name not in observation:
                given = ", ".join(map(str, observation)) or "nothing"
                raise ValueError(f"the observation has no array {name!r}, only {given}: give all of {expected}")
            if np.shape(observation[name]) != shape:
                found = np.shape(observation[name])
                raise ValueError(
                    f"{name!r} of the observation has shape {found}: give {shape}, that of one environment"
                )

    def _check_memory(self, memory):
        if not self._size and memory is not None:
            raise ValueError("memory is given, but this policy has none: leave it out")
        if self._size and (memory is None or np.shape(memory) != (self._size,)):
            given = "None" if memory is None else f"of shape {np.shape(memory)}"
            raise ValueError(f"memory is {given}: give shape ({self._size},), at first initial_memory()")

    def _normalized(self, observation):
        seen = {name: np.asarray(observation[name], np.float32) for name in self.describes["observation"]}
        for name in [name for name in seen if f"mean_of/{name}" in self.weights]:
            seen[name] = (seen[name] - self.weights[f"mean_of/{name}"]) * self.weights[f"scale_of/{name}"]
            if self.describes["observation_clip"] is not None:
                seen[name] = np.clip(
                    seen[name], -self.describes["observation_clip"], self.describes["observation_clip"]
                )
        return seen

    def _linear(self, name, x):
        return x @ self.weights[name + "kernel"] + self.weights[name + "bias"]

    def _layer(self, name, x):
        x = self._linear(name + "Dense_0/", x)
        x = (x - x.mean(axis=-1, keepdims=True)) / np.sqrt(x.var(axis=-1, keepdims=True) + 1e-6)
        return self.activation(x * self.weights[name + "LayerNorm_0/scale"] + self.weights[name + "LayerNorm_0/bias"])

    def _picture(self, name, x):
        """Layers of patches, 4 x 4 pixels at a stride of 4 and then 3 x 3 at a stride of 2, and one of what is left."""
        count = sum(key.startswith(name) and key.endswith("Dense_0/kernel") for key in self.weights)
        for i in range(count - 1):
            x = self._layer(f"{name}Layer_{i}/", _patches(x, *((4, 4) if i == 0 else (3, 2))))
        return self._layer(f"{name}Layer_{count - 1}/", x.reshape(-1))

    def _layers(self, name, x):
        i = 0
        while f"{name}Layer_{i}/Dense_0/kernel" in self.weights:
            x, i = self._layer(f"{name}Layer_{i}/", x), i + 1
        return x


def _patches(x, size, stride):
    height, width, _ = x.shape
    rows, columns = -(-height // stride), -(-width // stride)
    before = (size - stride + 1) // 2
    after = [max((n - 1) * stride + size - before - edge, 0) for n, edge in ((rows, height), (columns, width))]
    x = np.pad(x, ((before, after[0]), (before, after[1]), (0, 0)))
    parts = [
        x[i : i + stride * (rows - 1) + 1 : stride, j : j + stride * (columns - 1) + 1 : stride]
        for i in range(size)
        for j in range(size)
    ]
    return np.concatenate(parts, axis=-1)
