"""The documentation's code runs, from top to bottom of each page."""

import re
import runpy
from pathlib import Path

import jax
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


def code(page: str) -> str:
    """All Python blocks of a page, one after the other."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), flags=re.MULTILINE | re.DOTALL))


@pytest.fixture(scope="module")
def physics():
    names = {}
    exec(compile(code("docs/physics.md"), "docs/physics.md", "exec"), names)
    return names


def test_physics_page_runs_and_does_what_it_says(physics):
    assert all(
        np.isfinite(leaf).all() for leaf in jax.tree.leaves((physics["pressed"], physics["state"], physics["jumper"]))
    )
    assert float(physics["bodies"].velocity[0, 1]) < -0.05  # the block falls
    assert float(physics["jumper"].v[:, 1].max()) > 0.0  # the muscles move the table
    assert len(physics["x"]) + len(physics["pool"]) == sum(physics["two"].particle_counts)


def test_rigid_page_runs_and_does_what_it_says():
    names = {}
    exec(compile(code("docs/rigid.md"), "docs/rigid.md", "exec"), names)
    assert 0.1 < float(names["by_velocity"][0]) < 0.3  # it slides for about 0.2 s
    assert float(np.abs(names["by_model"]).max()) > 0.0 and np.isfinite(names["by_model"]).all()
    assert names["distance"]._cache_size() == 1


def test_the_example_of_a_rigid_task_trains(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main = runpy.run_path(str(ROOT / "examples" / "custom_rigid_task.py"))["main"]
    before, after = main(iterations=2)
    assert np.isfinite([before, after]).all() and before != after
    assert (tmp_path / "runs" / "custom-0" / "episode.png").stat().st_size > 10_000
    assert len((ROOT / "examples" / "custom_rigid_task.py").read_text().splitlines()) < 60
    arm = '<mujoco><worldbody><body><joint/><geom size="0.1"/></body></worldbody></mujoco>'
    with pytest.raises(AssertionError, match="the first joint is not free or a slide"):
        main(mjcf=arm)
