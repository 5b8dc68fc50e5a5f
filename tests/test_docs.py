"""The documentation's code runs, from top to bottom of each page, and so do the notebooks."""

import json
import re
import runpy
from pathlib import Path

import jax
import numpy as np
import pytest
import toys
from doc_pages import ROOT, code, run_page
from matplotlib.image import imread
from native_cases import NEEDS_COMPILER

import rewax
from rewax.physics.mpm import transfer_cpp
from rewax.testing import check_agent


@pytest.fixture(scope="module")
def physics():
    return run_page("docs/physics.md")


def test_physics_page_runs_and_does_what_it_says(physics):
    assert all(
        np.isfinite(leaf).all() for leaf in jax.tree.leaves((physics["pressed"], physics["state"], physics["jumper"]))
    )
    assert float(physics["bodies"].velocity[0, 1]) < -0.05  # the block falls
    assert float(physics["jumper"].v[:, 1].max()) > 0.0  # the muscles move the table
    assert float(physics["pressing"].qpos[0]) < -0.005 and float(np.abs(physics["touch"].force).max()) > 0.0
    assert len(physics["x"]) + len(physics["pool"]) == sum(physics["two"].particle_counts)


def test_rigid_page_runs_and_does_what_it_says():
    names = run_page("docs/rigid.md")
    assert 0.1 < float(names["by_velocity"][0]) < 0.3  # it slides for about 0.2 s
    assert float(np.abs(names["by_model"]).max()) > 0.0 and np.isfinite(names["by_model"]).all()
    assert names["distance"]._cache_size() == 1


def test_readme_runs_and_does_what_it_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = "num_iterations=2, "
    names = run_page("README.md", shorter={config: f"{config}num_eval_episodes=2, baselines=False, "})
    assert np.isfinite(names["slope"]).all() and np.any(names["slope"]) and names["slope"].shape == (10, 3)
    assert int(names["run"].train_state.iteration) == 2
    assert names["action"].shape == (1,) and -1.0 <= float(names["action"][0]) <= 1.0
    assert (tmp_path / "runs" / "mine" / "episode.png").is_file()


def test_start_page_trains_compares_and_resumes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    short = "num_iterations=2, seed=seed, plots=False, baselines=False, eval_every=0, num_eval_episodes=1"
    shorter = {"num_iterations=200, seed=seed": short, "num_episodes=64": "num_episodes=2"}
    names = run_page("docs/start.md", shorter=shorter)
    assert sorted(names["returns"]) == ["nothing", "random", "trained", "untrained"]
    assert len(set(names["returns"].values())) == 4 and np.isfinite(list(names["returns"].values())).all()
    assert int(names["run"].train_state.iteration) == 2 and names["result"].failure == ""


def test_rolling_flat_page_runs_and_does_what_it_says():
    env = run_page("docs/rolling_flat.md")["env"]
    assert env.scene.max_active_nodes is None and env.scene.grid.shape == (49, 49, 49)


def test_environments_page_runs_and_does_what_it_says():
    check = "check_env(env)"
    names = run_page("docs/environments.md", shorter={check: f"{check[:-1]}, check_full_episode=False)"})
    heights = np.asarray(names["states"].physics.soft.x)[:, :, 1]
    assert heights.shape[0] == 2 and np.abs(heights[0] - heights[1]).max() > 0.0
    drawn, material = names["state"].drawn, names["env"].scene.material
    factor = float(drawn[".scene.material.elasticity.youngs_modulus"]) / 600.0
    assert 0.5 <= factor <= 1.0 and 0.5 <= float(drawn[".scene.colliders[0].friction"]) < 0.9
    np.testing.assert_allclose(
        drawn[".scene.material.plasticity.yield_stress"], factor * material.plasticity.yield_stress, rtol=1e-5
    )
    shift = np.asarray(drawn[".scene.gravity"] - names["env"].scene.gravity)
    assert 0.0 < abs(shift[1]) <= 0.5 and shift[0] == shift[2] == 0.0 and len(drawn) == 4
    ant = names["heavier"](jax.random.key(0), names["rewax"].make("CartpoleSwingUp", scale="small"))
    assert ant.model.parameters["body_mass"].shape == (3,)
    assert isinstance(names["rewax"].make("VariedDough", scale="small"), names["Randomized"])
    assert names["rewax"].make("SofterDough", scale="small").scene.material.elasticity.youngs_modulus == 500.0
    dough, gentle = (names["rewax"].make(name, scale="small") for name in ("RollingFlat", "GentleRolling"))
    fast = names["state"].physics.replace(action=np.full(3, 0.5, np.float32))
    np.testing.assert_allclose(dough.reward(fast)[0] - gentle.reward(fast)[0], 0.075, rtol=1e-4)


def test_viz_page_runs_and_does_what_it_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_page("docs/viz.md")
    assert names["recording"].num_frames <= 61 and len(names["recording"].rewards) == names["recording"].steps[-1]
    assert names["speed"] == "in real time" and b"ftyp" in (tmp_path / "episode.mp4").read_bytes()[:16]
    assert names["page"].stat().st_size > 20_000


def test_the_algorithm_on_the_algorithms_page_learns_and_is_short():
    names = run_page("docs/algorithms.md")
    listing = code("docs/algorithms.md").split("import functools")[1]
    assert len(listing.strip().splitlines()) < 120
    assert es_learns(names)
    known = names["algorithm"]("short_horizon")
    config = known.config_type(
        num_envs=4, horizon=4, num_iterations=120, actor_learning_rate=1e-2, critic_learning_rate=5e-3,
        critic_passes=2, critic_minibatches=2, actor_widths=(8,), critic_widths=(8,), vector_features=8,
        stagger_episodes=True, differentiate="full",
    )  # fmt: skip
    agent = known.make(toys.point_mass(), config)
    state, rewards = agent.init(jax.random.key(0)), []
    for _ in range(120):
        state, metrics = agent.train_step(state)
        rewards.append(float(metrics["reward"]))
    assert np.mean(rewards[:2]) < -0.35 and np.mean(rewards[-20:]) > -0.2
    assert agent.name == "short_horizon" and int(state.env_steps) == 120 * 16


def es_learns(names):
    """Evolution strategies pass the check, and improve the reward per step on a point mass."""
    known = names["algorithm"]("es")
    config = known.config_type(
        num_envs=32, horizon=5, actor_learning_rate=2e-2, actor_widths=(8,), vector_features=8, initial_log_std=-2.0
    )
    agent = known.make(toys.point_mass(), config)
    check_agent(agent, toys.point_mass(), notify=None)
    state, rewards = agent.init(jax.random.key(0)), []
    for _ in range(150):
        state, metrics = agent.train_step(state)
        rewards.append(float(metrics["reward"]))
    return np.mean(rewards[:2]) < -0.35 and np.mean(rewards[-20:]) > -0.25


@NEEDS_COMPILER
def test_the_lowering_page_says_what_runs_in_cpp():
    names = run_page("docs/lowering.md")
    assert {decision.rule for decision in names["decisions"]} == {"cotangent"}


def test_every_page_with_code_is_run_here():
    pages = [path for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")] if "```python" in path.read_text()]
    here = "".join(path.read_text() for path in Path(__file__).parent.glob("test_docs*.py"))
    assert not [page.name for page in pages if f'"{page.relative_to(ROOT)}"' not in here]


def test_the_page_of_a_task_on_a_robot_runs():
    names = run_page("docs/your_own_rigid_task.md")
    assert "MyTask" in rewax.list_envs() and names["env"].num_actions == 1


@pytest.mark.slow
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


def test_the_page_of_clouds_and_tools_runs_and_does_what_it_says():
    names = run_page("docs/clouds_and_tools.md")
    assert names["seen"].shape == (32, 6)
    assert [collider.body for collider in names["tools"]] == [1]
    np.testing.assert_allclose(names["poses"].position[:, 1, 0], np.linspace(0.0, 0.1, 11), atol=1e-7)


def test_the_tutorial_of_a_soft_task_runs(capsys):
    names = run_page("docs/your_own_soft_task.md")
    assert capsys.readouterr().out.splitlines()[0] == "OK"
    env, rest = names["env"], float(names["FLOOR"])
    lowest = float(names["after"].x[:, 1].min())
    assert rest - 0.51 * names["SPACING"] < lowest < rest
    assert "Press" in names["rewax"].list_envs() and names["agent"].name == "sapo" and env.num_actions == 1


def test_the_page_of_cameras_runs(capsys):
    names = run_page("docs/sensors.md")
    assert capsys.readouterr().out.splitlines()[:2] == ["(64, 64, 1) (256, 3)", "(64, 64, 1)"]
    depth = np.asarray(names["state"].obs["depth"])
    assert depth.min() < 0.9 < depth.max() == 1.0, "the camera sees the cart"
    assert names["agent"].config.observe == ("depth",) and "depth" not in names["agent"].config.critic_observe
    assert {name: names["touched"][name].shape for name in ("touch", "palm", "floor")} == {
        "touch": (108,), "palm": (24,), "floor": (6,),
    }  # fmt: skip


def test_the_torus_of_the_shapes_page_pushes_is_filled_and_is_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = run_page("docs/your_own_shape.md")
    assert capsys.readouterr().out.splitlines()[-1].endswith("passed")
    listing = code("docs/your_own_shape.md").split("from rewax.testing import")[0]
    assert len([line for line in listing.splitlines() if line.strip()]) < 40
    torus, x = names["torus"], np.asarray(names["x"]) - [0.25, 0.33, 0.25]
    assert np.all((np.hypot(x[:, 0], x[:, 2]) - 0.1) ** 2 + x[:, 1] ** 2 < 0.04**2)
    np.testing.assert_allclose(names["volume"](torus), 2.0 * np.pi**2 * 0.1 * 0.04**2, rtol=2e-3)
    after = np.asarray(names["after"].x) - [0.25, 0.15, 0.25]
    depth = 0.04 - np.hypot(np.hypot(after[:, 0], after[:, 1]) - 0.1, after[:, 2])  # of particles in the rigid one
    assert depth.max() < 0.02 and 0.04 < after[:, 1].mean() < 0.15  # it hangs on the upper half
    assert float(names["slope"]) > 0.5
    (drawing,) = names["drawings"](names["scene"].colliders, names["body"])
    low, high = (np.asarray(drawing["vertices"]).min(axis=0), np.asarray(drawing["vertices"]).max(axis=0))
    np.testing.assert_allclose([low, high], [[-0.14, -0.04, -0.14], [0.14, 0.04, 0.14]], atol=2e-3)
    assert imread(tmp_path / "torus.png").shape == imread(ROOT / "docs/pictures/torus.png").shape


def test_the_page_of_a_contact_pair_runs():
    names = run_page("docs/your_own_contact_pair.md")
    assert float(names["state"].qpos[2]) == pytest.approx(0.15, abs=1e-3)
    assert names["model"].static.collisions.functions == (names["pair"],)


def test_the_page_of_a_law_runs(capsys):
    names = run_page("docs/your_own_law.md")
    assert capsys.readouterr().out.count("passed") == 3
    for listing in re.split(r"```python\n", (ROOT / "docs/your_own_law.md").read_text())[1:4]:
        assert len([line for line in listing.split("```")[0].splitlines() if line.strip()]) < 40
    assert names["tearing"].initial_memory == (0.0,)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tet", "soft", "coupled"])
def test_the_examples_of_soft_tasks_train(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = ROOT / "examples" / f"custom_{kind}_task.py"
    before, after = runpy.run_path(str(path))["main"](iterations=1, check=False)
    assert np.isfinite([before, after]).all() and before != after
    (picture,) = tmp_path.glob("runs/*-0/episode.png")
    assert picture.stat().st_size > 10_000
    assert len(path.read_text().splitlines()) <= 101


def test_adapters_page_runs_and_does_what_it_says():
    names = run_page("docs/adapters.md")
    assert names["info"]["status"] == "OK" and names["rewards"].shape == (16,)
    assert names["timestep"].first()


def test_adapters_page_carries_gradients_into_torch():
    pytest.importorskip("torch", reason="pip install 'rewax[torch]'")
    names = run_page("docs/adapters.md", "torch")
    actions, weight = names["actions"], names["net"].weight
    assert np.isfinite(weight.grad.numpy()).all() and float(weight.grad.abs().max()) > 0.0
    assert np.isfinite(actions.grad.numpy()).all() and float(actions.grad.abs().max()) > 0.0


def test_gradients_page_runs_and_does_what_it_says():
    names = run_page("docs/gradients.md")
    reverse, forward, central = (float(names[name]) for name in ("reverse", "forward", "central"))
    np.testing.assert_allclose(reverse, 3.1656254, rtol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)
    np.testing.assert_allclose(reverse, central, rtol=1e-6)
    assert abs(float(names["inside"][0])) > 0.1 and float(names["outside"][0]) == 0.0
    assert not names["by_action"][:3].any() and (np.abs(names["by_action"][3:]) > 0.1).all()


def test_troubleshooting_page_runs_and_does_what_it_says(capsys):
    names = run_page("docs/troubleshooting.md")
    text = (ROOT / "docs" / "troubleshooting.md").read_text()
    assert str(names["found"]).startswith(
        "v of particle 7 is not finite at the start; before: x [0.1562 0.1562 0.2438]"
    )
    assert capsys.readouterr().out.startswith("NAN physics.rigid.qpos\n")
    expected = "0.748" if transfer_cpp.is_used() else "0.901"
    assert f"{names['peak'] / 1e9:.3f}" == expected and expected in text
    assert not [bit.name for bit in rewax.Status if f"| `{bit.name}` |" not in text]


@pytest.mark.parametrize(
    ("name", "shorter"),
    [
        ("gradient_through_mpm", {}),
        ("identify_a_material", {"range(20)": "range(4)"}),
        (
            "train_and_watch",
            {"NUM_ITERATIONS = 600": "NUM_ITERATIONS = 2", "eval_every=100": "num_eval_episodes=1, baselines=False"},
        ),
    ],
)
def test_notebooks_run(name, shorter, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    path = ROOT / "examples" / "notebooks" / f"{name}.ipynb"
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] or cell["execution_count"] for cell in cells), "strip the outputs"
    source = "\n\n".join("".join(cell["source"]) for cell in cells)
    for long, short in shorter.items():
        assert source.count(long) == 1
        source = source.replace(long, short)
    names = {}
    exec(compile(source, str(path), "exec"), names)
    if name == "gradient_through_mpm":
        assert names["error"] < 5e-3 and abs(names["history"][-1] - names["MARK"]) < 1e-4
    elif name == "identify_a_material":
        assert names["found"] == sorted(names["found"]) and names["found"][-1] > 0.85 * names["TRUE"]
    else:
        assert np.isfinite(names["rewards"]).all() and names["result"].failure == ""
