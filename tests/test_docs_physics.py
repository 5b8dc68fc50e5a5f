"""Pages of physics beyond the first: their code runs and does what they say."""

import numpy as np
import pytest
from doc_pages import run_page


def test_page_of_cloth_and_ropes_runs_and_does_what_it_says():
    names = run_page("docs/cloth_and_ropes.md")
    assert (
        float(names["lifted"](names["hand"], np.ones((200, 1), np.float32))) > 0.03
    )  # the closed hand takes the corner along
    assert float(names["wrench"].force[0, 1]) > 0.3  # the sheet pushes the box up
    assert float(names["landed"].velocity[0, 1]) > -1.9  # and brakes its fall
    fallen = np.asarray(names["poured"].particles.x)[:, 1]
    assert -5e-3 < fallen.min() < 9e-3 and names["poured"].thin.v.shape == (81, 3)
    assert np.abs(names["by_grip"]).max() > 1e-6 and np.abs(names["by_hand"]).max() > 0.1
    assert np.linalg.norm(names["draped"].x - np.array([0.2, -0.11, 0.2]), axis=1).min() > 0.098  # outside of the ball
    assert np.isfinite(names["slope"]).all() and np.abs(names["slope"]).max() > 0 and names["swung"].x[-1, 1] < -0.02


def test_page_of_tasks_on_cloth_runs():
    env = run_page("docs/cloth_tasks.md")["env"]
    assert env.action_spec.shape == (3,) and env.appearance["material_names"] == ("cloth",)


def test_the_page_of_identification_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_page("docs/identify.md")
    (value,) = names["found"].values.values()
    assert float(names["same"].scene.material.plasticity.yield_stress) == pytest.approx(value, rel=1e-6)
