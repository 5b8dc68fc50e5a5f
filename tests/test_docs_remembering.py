"""The page of policies that remember runs, and shows the rows of its benchmark."""

import numpy as np
from doc_pages import ROOT, run_benchmark, run_page


def test_the_page_of_policies_that_remember_runs_and_shows_its_rows():
    names = run_page("docs/policies_that_remember.md")
    assert names["env"].observation_spec["state"].shape == (20,)
    assert names["memory"].shape == (32,) and np.any(names["memory"] != 0.0) and int(names["state"].step_count) == 3
    benchmark = run_benchmark("memory")
    rows = benchmark["read"](ROOT / "docs/suites/memory/results.csv")
    assert len(rows) > 40 and benchmark["table"](rows) in (ROOT / "docs/policies_that_remember.md").read_text()
