"""A trained policy in NumPy; it needs this file and ``weights.npz`` only.

policy = NumpyPolicy("weights.npz")
action = policy(observation)                    # observation: dict of arrays of one environment; deterministic
action = policy(observation, noise)             # noise: standard normal numbers, one per action component
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
    """Observation to action; ``describes`` says what was trained and which observation it expects."""

    def __init__(self, path):
        with np.load(path) as file:
            self.weights = {name: file[name] for name in file.files}
        self.describes = json.loads(str(self.weights.pop("describes")))
        self.activation = ACTIVATIONS[self.describes["activation"]]

    def __call__(self, observation, noise=0.0):
        seen, features = self._normalized(observation), []
        clouds = sorted(name for name, a in seen.items() if a.ndim == 2)
        for name in clouds:
            points = self._layers(f"encoder/points_{name}/", seen[name])
            features.append(self._layer(f"encoder/pooled_{name}/", points.mean(axis=0)))
        vectors = [seen[name].reshape(-1) for name in sorted(seen) if name not in clouds]
        if vectors:
            features.append(self._layer("encoder/vectors/", np.concatenate(vectors)))
        x = self._layers("MLP_0/", np.concatenate(features))
        log_std = self.weights["log_std"] if "log_std" in self.weights else self._linear("log_std/", x)
        std = np.exp(np.clip(log_std, *self.describes["log_std_range"]))
        return np.tanh(self._linear("mean/", x) + std * noise)

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

    def _layers(self, name, x):
        i = 0
        while f"{name}Layer_{i}/Dense_0/kernel" in self.weights:
            x, i = self._layer(f"{name}Layer_{i}/", x), i + 1
        return x
