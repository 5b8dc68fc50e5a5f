"""Training: the loop, storage, evaluations, pictures and suites of runs. Names are imported when first used."""

from typing import TYPE_CHECKING

from rewax.lazy import lazy_names

if TYPE_CHECKING:
    from rewax.training.config import ReportConfig, TrainConfig
    from rewax.training.evaluation.episodes import constant_policy, evaluate_actions, make_evaluate, uniform_policy
    from rewax.training.evaluation.recording import record
    from rewax.training.loop.compare import train_and_compare
    from rewax.training.loop.compilation import compile_train_step
    from rewax.training.loop.train import train
    from rewax.training.storage.cache import enable_compilation_cache
    from rewax.training.storage.metrics import read_csv
    from rewax.training.storage.saved import load_run
    from rewax.training.suites.suite import Suite, read_suite

_HOMES = {
    **dict.fromkeys(("ReportConfig", "TrainConfig"), "rewax.training.config"),
    "train": "rewax.training.loop.train",
    "train_and_compare": "rewax.training.loop.compare",
    "compile_train_step": "rewax.training.loop.compilation",
    "enable_compilation_cache": "rewax.training.storage.cache",
    "load_run": "rewax.training.storage.saved",
    "read_csv": "rewax.training.storage.metrics",
    **dict.fromkeys(
        ("constant_policy", "evaluate_actions", "make_evaluate", "uniform_policy"), "rewax.training.evaluation.episodes"
    ),
    "record": "rewax.training.evaluation.recording",
    **dict.fromkeys(("Suite", "read_suite"), "rewax.training.suites.suite"),
}

__getattr__, __dir__ = lazy_names(__name__, _HOMES)

__all__ = [
    "ReportConfig", "Suite", "TrainConfig", "compile_train_step", "constant_policy", "enable_compilation_cache",
    "evaluate_actions", "load_run", "make_evaluate", "read_csv", "read_suite", "record", "train", "train_and_compare",
    "uniform_policy",
]  # fmt: skip
