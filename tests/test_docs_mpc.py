"""The page of model-predictive control shows the rows of its benchmark."""

from doc_pages import ROOT, run_benchmark


def test_the_page_of_model_predictive_control_shows_its_rows():
    """Fill it with ``model_predictive.py --report | page_tables.py docs/mpc.md`` after rows of one of the suites changed."""
    benchmark = run_benchmark("model_predictive")
    rows, others = (benchmark["stored"].read(benchmark[name]) for name in ("RESULTS", "OTHERS"))
    table = benchmark["report"](rows, others)
    assert len(table.splitlines()) == 10 and table in (ROOT / "docs/mpc.md").read_text()
