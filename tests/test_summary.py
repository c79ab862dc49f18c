"""What `make test` says last."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests import recipes
from tests.parity.patience import BUSY
from tests.recipes import ON_ALL, ON_ONE, VCAN, run_all
from tests.summary import WIDTH, summarise

ROOT = Path(__file__).resolve().parent.parent

PARTS = (*ON_ONE, *ON_ALL, VCAN)

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


@pytest.mark.long
def test_skipped_are_counted_with_their_reasons(report: Path) -> None:
    """Most frequent first, each in a line; those of a busy machine are counted by themselves."""
    lines, is_well = summarise([report, report], None)
    assert is_well
    assert lines[0] == "make test: 2 passed, 8 skipped, 6 of them because the machine was too busy"
    assert lines[1].startswith(f"  skipped 6: {BUSY}: late by 1 ms, 50 % within 0.5 ms, xxx")
    assert lines[1].endswith("x ...")
    assert lines[2:] == ["  skipped 2: there is no such device here"]


@pytest.mark.long
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


@pytest.mark.long
def test_recipe_that_failed_is_told_and_no_success(report: Path) -> None:
    """Also one that leaves no report, such as lint; the counts are there all the same."""
    lines, is_well = summarise([report], None, ["lint", "compile"])
    assert not is_well
    assert lines[0].startswith("make test: 1 passed, 4 skipped")
    assert lines[-2:] == ["make lint failed", "make compile failed"]


@pytest.mark.parametrize(("beside", "order"), [(False, PARTS), (True, (*ON_ONE, VCAN, *ON_ALL))])
@pytest.mark.parametrize("bad", PARTS)
def test_recipes_go_on_after_one_that_failed(
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    beside: bool,
    order: tuple[str, ...],
    bad: str,
) -> None:
    """`make test` runs all of them whatever fails; what ran beside others is shown whole, when it has ended."""
    recipes = "\n".join(f"{one}:\n\t@echo ran $@; {'false' if one == bad else 'true'}" for one in PARTS)
    (tmp_path / "Makefile").write_text(recipes)
    monkeypatch.chdir(tmp_path)
    assert run_all("make", tmp_path / "vcan.log", beside) == [bad]
    said = [line for line in capfd.readouterr().out.splitlines() if line.startswith("ran ")]
    assert said == [f"ran {one}" for one in order]


def test_the_parts_are_recipes_of_the_makefile() -> None:
    """And `make test` runs them."""
    makefile = (ROOT / "Makefile").read_text()
    assert all(f"\n{one}: " in makefile for one in PARTS)
    assert "python -m tests.recipes $(THIS_MAKE) $(REPORTS)" in makefile


@pytest.mark.parametrize(("failed", "reported", "code"), [([], PARTS, 0), (["lint"], PARTS, 1), ([], ("unit",), 1)])
def test_exit_code_is_0_when_all_went_well(
    tmp_path: Path, report: Path, monkeypatch: pytest.MonkeyPatch, failed: list[str], reported: list[str], code: int
) -> None:
    """A recipe that fails and a report that is not there are failures; what lay there before does not count."""
    reports = tmp_path / "reports"
    reports.mkdir()
    for name in PARTS:
        (reports / f"{name}.xml").write_text("of an earlier run")

    def run_them(make: str, log: Path, beside: bool) -> list[str]:
        assert list(reports.iterdir()) == []
        for name in reported:
            (reports / f"{name}.xml").write_bytes(report.read_bytes())
        return failed

    monkeypatch.setattr(recipes, "run_all", run_them)
    monkeypatch.setattr(sys, "argv", ["recipes", "make", str(reports)])
    assert recipes.main() == code


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_recipes_end_before_it_does(tmp_path: Path, number: int, code: int, beside: bool) -> None:
    """Ctrl-C reaches all of them, SIGTERM this one alone: none is left, and what they said is shown."""
    work = "@trap 'kill $$!; sleep 0.3; echo ended $@; exit 1' INT TERM; sleep 60 & echo begun $@; wait"
    (tmp_path / "Makefile").write_text(f"lint vcan:\n\t{work}\n")
    program = (
        "import sys; from tests import recipes\n"
        f"recipes.can_be_beside = lambda: {beside}\n"
        "sys.argv = ['recipes', 'make', 'reports']; sys.exit(recipes.main())"
    )
    asked = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    wanted = {"lint", "vcan"} if beside else {"lint"}
    log = tmp_path / "reports" / "vcan.log"
    deadline = time.monotonic() + 60
    with asked:
        assert asked.stdout is not None
        while asked.stdout.readline() != "begun lint\n":
            assert time.monotonic() < deadline
        while beside and (not log.exists() or "begun" not in log.read_text()):
            assert time.monotonic() < deadline
        if number == signal.SIGINT:
            os.killpg(asked.pid, number)
        else:
            os.kill(asked.pid, number)
        said = asked.stdout.read().splitlines()
    assert asked.returncode == code
    assert {line.removeprefix("ended ") for line in said if line.startswith("ended ")} == wanted


def test_flags_of_the_make_that_called_go_on_but_for_its_job_server() -> None:
    given = ["w", "-j2", "--jobserver-auth=3,4", "--", "PYTHON=python3.12"]
    assert recipes.flags(given) == ["w", "--", "PYTHON=python3.12"]
