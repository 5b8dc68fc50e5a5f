"""The gallery, docs/gallery.md: each task's pictures, what its shipped policy earns, and how to see it.

    python benchmarks/gallery_page.py

Pictures and curves are those of the tasks' pages (``benchmarks/gallery.py``); numbers are those of the policies' cards.
"""

import inspect
import pkgutil
import re
from collections.abc import Mapping
from pathlib import Path

import tyro

import rewax
from rewax.envs.registry import _FACTORIES
from rewax.training.evaluation.programs import MODES
from rewax.training.storage.policies import list_policies, read_card

HEAD = """# Gallery

This page shows each task at scale `small`, and the trained policy that comes with rewax. One command records an episode
and writes a page for the browser, which needs no network:

```bash
rewax play HandFlip        # writes player.html; several tasks side by side: rewax play HandFlip SteerFloat
rewax eval HandFlip        # returns of 64 episodes, and a video
```

With empty caches the first command takes 12 s on two cores of an EPYC (one run). It also builds the C++ libraries:

    time XDG_CACHE_HOME=$(mktemp -d) rewax play HandFlip

The tables show mean returns of 64 episodes with their 95 % bootstrap interval, from the same starts in all columns.
Each policy is one of the best of all algorithms and seeds whose weights are kept. TrajOpt finds sequences of actions,
no policies. So a policy's return is not that of [the suite](measured/small_suite.md), which compares all algorithms
over several seeds. AntRun also has one at scale `paper`: `rewax play AntRun --scale paper`. Pictures and curves come
from the [tasks' pages](tasks/index.md), where SAPO was trained with three seeds, and from
[cloth and ropes](cloth_tasks.md#returns).
The command `rewax train` below a table uses the presets of today. Those of FoldCloth
and WhipRope have changed since the policy's commit.
In code, `rewax.load_policy("HandFlip")` loads a policy ([trained policies](adapters.md#trained-policies)).

    python benchmarks/ship_policies.py RUNS     # the best run of each task, checked, into rewax/policies
    python benchmarks/gallery_page.py
"""


def sentence(name: str) -> str:
    """The first of the task's module, or of its factory where the module is another task's."""
    factory = _FACTORIES[name]
    factory = factory["small"] if isinstance(factory, Mapping) else factory
    factory = pkgutil.resolve_name(factory) if isinstance(factory, str) else factory
    said = (inspect.getmodule(factory).__doc__ or "").split("\n\n")[0]  # type: ignore[union-attr]
    if not said.startswith(f"{name}:"):
        said = (factory.__doc__ or "").split("\n\n")[0]
    return re.sub(r"``(.*?)``", r"`\1`", said.replace("\n", " "))


def section(name: str, docs: Path) -> list[str]:
    """Of one task."""
    lines = [f"## {name}", "", sentence(name), ""]
    if (docs / "tasks" / f"{name}.jpg").is_file():
        lines += [f"![{name}: an episode of a trained policy](tasks/{name}.jpg)", ""]
    if (name, "small") in list_policies():
        lines += earned(name, "small")
    else:
        train, play = f"rewax train --env {name} --scale small", f"rewax play runs/{name}-small-0"
        lines += [f"No policy of it is shipped. `{train}` makes one, `{play}` shows it.", ""]
    if (name, "paper") in list_policies():
        lines += ["At scale `paper`:", "", *earned(name, "paper")]
    for curve in (f"tasks/{name}_curve.png", f"suites/thin/{name}.png"):
        if (docs / curve).is_file():
            lines += [f"![{name}: learning curves]({curve})", ""]
    return lines


def earned(name: str, scale: str) -> list[str]:
    """Returns of the shipped policy, and its commands."""
    card = read_card(name, scale=scale)
    modes = ("deterministic", "sampled", "no action", "random actions")
    assert set(modes) == set(MODES)
    cells = [
        f"{_number(of['mean'])} [{_number(of['low'])}, {_number(of['high'])}]" for of in map(card["returns"].get, modes)
    ]
    trained = card["trained"]
    return [
        f"| {' | '.join(modes)} |",
        "|---|---|---|---|",
        f"| {' | '.join(cells)} |",
        "",
        f"    rewax play {name}{' --scale paper' * (scale == 'paper')}",
        f"    {card['command']}     # how it was trained: {card['env_steps']:,} steps, commit {trained['commit']}",
        "",
    ]


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.1f}"


def main(docs: Path = Path("docs")) -> int:
    lines = [HEAD]
    for name in rewax.list_envs():
        lines += section(name, docs)
    (docs / "gallery.md").write_text("\n".join(lines).rstrip() + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main, description=__doc__))
