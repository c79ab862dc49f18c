"""What `make test` says last."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.parity.patience import BUSY
from tests.summary import WIDTH, summarise

ROOT = Path(__file__).resolve().parent.parent

PARTS = ("lint", "unit", "runs", "realtime", "vcan", "compile")

TESTS = f'''
import pytest

def test_passes(): pass
@pytest.mark.parametrize("number", range(3))
def test_late(number): pytest.skip("{BUSY}: late by 1 ms,\\n50 % within 0.5 ms, " + "x" * {WIDTH})
def test_elsewhere(): pytest.skip("there is no such device here")
'''


@pytest.fixture
def report(tmp_path: Path) -> Path:
    """Of one pytest run, as the recipes make it."""
    (tmp_path / "test_some.py").write_text(TESTS)
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--junitxml=some.xml", "test_some.py"]
    subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=100)
    return tmp_path / "some.xml"


def test_skipped_are_counted_with_their_reasons(report: Path) -> None:
    """Most frequent first, each in a line; those of a busy machine are counted by themselves."""
    lines, is_well = summarise([report, report], None)
    assert is_well
    assert lines[0] == "make test: 2 passed, 8 skipped, 6 of them because the machine was too busy"
    assert lines[1].startswith(f"  skipped 6: {BUSY}: late by 1 ms, 50 % within 0.5 ms, xxx")
    assert lines[1].endswith("x ...")
    assert lines[2:] == ["  skipped 2: there is no such device here"]


def test_compiled_build_that_is_missing_counts_as_skipped(report: Path) -> None:
    """It is no pytest run, and part of `make test` all the same."""
    lines, _ = summarise([report], "there is no C compiler")
    assert "5 skipped" in lines[0]
    assert "  skipped 1: compiled build: there is no C compiler" in lines


@pytest.mark.parametrize("content", [None, "<testsuites>", '<a><testcase name="test_x"><failure/></testcase></a>'])
def test_part_that_failed_or_left_no_report_is_no_success(tmp_path: Path, content: str | None) -> None:
    """Nothing is called passed that did not pass."""
    path = tmp_path / "unit.xml"
    if content is not None:
        path.write_text(content)
    lines, is_well = summarise([path], None)
    assert not is_well
    assert str(path) in lines[-1]


def test_recipe_that_failed_is_told_and_no_success(report: Path) -> None:
    """Also one that leaves no report, such as lint; the counts are there all the same."""
    lines, is_well = summarise([report], None, ["lint", "compile"])
    assert not is_well
    assert lines[0].startswith("make test: 1 passed, 4 skipped")
    assert lines[-2:] == ["make lint failed", "make compile failed"]


def test_recipes_go_on_after_one_that_failed(tmp_path: Path) -> None:
    """`make test` runs all of them whatever fails, and fails in the end."""
    rule = (ROOT / "Makefile").read_text().split("\ntest: ")[1].split("\n\n")[0].replace("$(READY)", "")
    recipes = "\n".join(f"{one}:\n\t@echo ran $@; {'false' if one == 'unit' else 'true'}" for one in PARTS)
    (tmp_path / "Makefile").write_text(f"BIN := .\nREPORTS := reports\ntest: {rule}\n{recipes}\n")
    (tmp_path / "python").write_text('#!/bin/sh\necho "$@"\ncase "$4" in "") exit 0;; *) exit 1;; esac\n')
    (tmp_path / "python").chmod(0o755)
    ended = subprocess.run(["make", "test"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert [line for line in ended.stdout.splitlines() if line.startswith("ran ")] == [f"ran {one}" for one in PARTS]
    assert ended.returncode != 0
    assert "--failed  unit reports/unit.xml" in ended.stdout
