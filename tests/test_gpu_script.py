"""benchmarks/gpu.sh is valid bash, its parts name files and modules that exist, and it keeps what a part wrote."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SCRIPT = ROOT / "benchmarks" / "gpu.sh"
BASH = shutil.which("bash")
needs_bash = pytest.mark.skipif(BASH is None, reason="there is no bash")


@needs_bash
def test_it_is_valid_bash():
    checked = subprocess.run([str(BASH), "-n", str(SCRIPT)], capture_output=True, text=True)
    assert checked.returncode == 0, checked.stderr


def test_its_parts_name_files_that_exist_and_all_have_a_limit():
    lines = [line.split() for line in SCRIPT.read_text().splitlines() if re.match(r"\s+part ", line)]
    names = {words[1].strip('"').split(":")[0] for words in lines}
    default = re.search(r"PARTS:-([\w ]+)", SCRIPT.read_text())
    assert default and names == set(default.group(1).split())
    for words in lines:
        assert 0 < int(words[2]) <= 900, words
        assert words[3].endswith(".txt"), words
        if words[1] == "compile":  # runs commands of the others
            continue
        assert words[4] == '"$PYTHON"', words
        assert words[5:7] == ["-m", "rewax"] or (ROOT / words[5]).is_file(), words


def test_quick_and_long_runs_have_the_same_parts():
    quick, long = SCRIPT.read_text().split('if [ -n "$QUICK" ]; then\n')[-1].split("\nelse\n")
    files = [set(re.findall(r"\bpart [^\n]* (\w+\.txt)", text)) for text in (quick, long)]
    assert files[0] == files[1] and len(files[0]) == 7
    assert "compile_all" in quick and "compile_all" in long


def test_all_programs_compiled_ahead_are_timed_later():
    """Each command that only fills the cache names a benchmark that a later part runs."""
    text = SCRIPT.read_text()
    ahead = set(re.findall(r"\$PYTHON (benchmarks/\w+\.py)", text))
    timed = set(re.findall(r'"\$PYTHON" (benchmarks/\w+\.py)', text))
    assert ahead and ahead <= timed


@needs_bash
def test_a_part_that_is_cut_off_leaves_what_it_wrote(tmp_path):
    """A Python that prints a line and hangs stands in for a benchmark; the run goes on to the next part."""
    python = tmp_path / "python"
    python.write_text(
        f'#!/bin/sh\nif [ "$1" = -c ]; then exec {sys.executable} -c "print(1)"; fi\necho "began $1"; exec sleep 60\n'
    )
    python.chmod(0o755)
    environment = {
        "PATH": "/usr/bin:/bin", "QUICK": "1", "PYTHON": str(python), "BUDGET": "10", "PARTS": "agreement step",
    }  # fmt: skip
    done = subprocess.run(
        [str(BASH), str(SCRIPT), str(tmp_path / "out")], env=environment, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert "began benchmarks/gpu_agreement.py" in (tmp_path / "out" / "agreement.txt").read_text()
    assert "agreement: exit code 124" in done.stdout and "step:RollingFlat: left out" in done.stdout


@needs_bash
def test_parts_that_run_side_by_side_count_when_they_fail(tmp_path):
    """A stand-in for Python fails for one task of five."""
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\ncase "$*" in *FluidMove) exit 1;; esac\n')
    python.chmod(0o755)
    environment = {"PATH": "/usr/bin:/bin", "PYTHON": str(python), "PARTS": "agreement"}
    done = subprocess.run(
        [str(BASH), str(SCRIPT), str(tmp_path / "out")], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 1 and "agreement:FluidMove: exit code 1 " in done.stdout
    assert "done, 1 parts failed" in done.stdout
