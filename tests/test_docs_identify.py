"""The page of identification shows the rows of its benchmarks."""

from doc_pages import ROOT, run_benchmark

PAGE, FOLDER = ROOT / "docs/identify.md", ROOT / "docs/suites/identify"


def test_the_page_shows_the_rows_of_the_cases():
    benchmark = run_benchmark("identify_cases")
    rows, text = benchmark["stored"].read(FOLDER / "results.csv"), PAGE.read_text()
    assert len(rows) > 20 and all(table in text for table in benchmark["report"](rows).split("\n\n"))


def test_the_page_shows_the_rows_of_the_loop():
    benchmark = run_benchmark("identify_loop")
    rows, text = benchmark["read"](FOLDER / "loop.csv"), PAGE.read_text()
    assert rows and all(table in text for table in benchmark["tables"](rows).split("\n\n"))
