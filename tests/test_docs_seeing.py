"""The page of policies that see runs, and shows the rows of its benchmark."""

import jax
import numpy as np
import pytest
from doc_pages import ROOT, run_benchmark, run_page

import rewax


def test_the_page_of_policies_that_see_runs_and_shows_its_rows():
    names = run_page("docs/policies_that_see.md")
    env, late = names["env"], names["late"]
    depth = np.asarray(jax.jit(env.reset)(jax.random.key(0)).obs["depth"])
    assert depth.shape == (64, 64, 1) and 0.05 < depth.min() < 0.4 and depth.max() < 1.0  # the pin is not cut away
    drawn = names["moved"](jax.random.key(0), late).env.sensors["depth"]
    assert 0.0 < np.abs(drawn.position - env.sensors["depth"].position).max() <= 0.01 and drawn.noise.constant < 0.004
    assert (late.observation, late.action, late.of) == ((0, 2), (0, 1), ("depth",))
    assert names["robust"].config.observe == ("depth", "joint_q", "joint_qd")
    assert set(names["robust"].config.critic_observe) == set(env.env.observation_spec)
    moving = rewax.make("MovingCamera", scale="small")
    poses = [np.asarray(jax.jit(moving.reset)(jax.random.key(i)).drawn[".sensors['depth'].position"]) for i in range(2)]
    assert 0.0 < np.abs(poses[0] - poses[1]).max() <= 0.1
    assert 0.05 < names["picture"].min() < 0.4
    benchmark = run_benchmark("seeing")
    rows, text = (
        benchmark["read"](ROOT / "docs/suites/seeing/results.csv"),
        (ROOT / "docs/policies_that_see.md").read_text(),
    )
    assert len(rows) > 100 and all(table in text for table in benchmark["tables"](rows).split("\n\n"))


def test_the_page_shows_the_rows_of_blind_dough():
    benchmark = run_benchmark("blind_dough")
    rows, text = benchmark["read"](ROOT / "docs/suites/blind_dough/results.csv"), ROOT / "docs/policies_that_see.md"
    assert rows and benchmark["table"](rows) in text.read_text()


def test_printed_tables_take_the_place_of_those_with_the_same_first_line():
    filled = run_benchmark("page_tables")["filled"]
    page = "Before\n\n| a | b |\n|---|---|\n| 1 | 2 |\n\nbetween\n\n| c |\n|---|\n| 3 |\n"
    assert filled(page, ["| a | b |\n|---|---|\n| 4 | 5 |\n| 6 | 7 |"]) == page.replace(
        "| 1 | 2 |", "| 4 | 5 |\n| 6 | 7 |"
    )
    for other in ("| d |\n|---|", "| a |\n|---|"):
        with pytest.raises(ValueError, match=r"^the page has 0 tables that begin with"):
            filled(page, [other])


def test_cells_are_run_once_and_their_rows_written_as_they_are_finished(tmp_path):
    rows, path, run = run_benchmark("rows"), tmp_path / "results.csv", []
    fields = ("column", "seed", "at", "return", "commit")

    def of_cell(column, seed):
        if (column, seed) == ("b", 0):
            raise KeyboardInterrupt  # what was finished before stays
        run.append((column, seed))
        return [{"at": at, "return": seed + k} for k, at in enumerate(("near", "far"))] if column == "a" else {"at": ""}

    cells = [{"column": column, "seed": seed} for column in "ab" for seed in (0, 1)]
    with pytest.raises(KeyboardInterrupt):
        rows["fill"](cells, of_cell, fields, path)
    assert run == [("a", 0), ("a", 1)] and len(rows["read"](path)) == 4
    rows["fill"]([cells[0], cells[3]], of_cell, fields, path)
    found = rows["read"](path)
    assert run == [("a", 0), ("a", 1), ("b", 1)] and len(found) == 5 and all(row["commit"] for row in found)
    assert rows["returns"](found, column="a", at="far") == [1.0, 2.0]
