"""The examples run: they are what a user copies from."""

import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "examples" / "hil_tests"


@pytest.mark.run
def test_the_hil_suite_passes_in_virtual_time(tmp_path: Path) -> None:
    """examples/hil_tests with the plug-in as installed: all pass, none is skipped, every test names a requirement."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTEST_", "PYTHON"))}
    report = tmp_path / "report.xml"
    arguments = ["-p", "no:cacheprovider", f"--basetemp={tmp_path / 'temporary'}", f"--junitxml={report}"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *arguments, str(EXAMPLES)],
        cwd=tmp_path,
        env={**environment, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    suite = ET.parse(report).getroot()[0]
    cases = suite.findall("testcase")
    assert len(cases) >= 10
    assert suite.get("skipped") == "0"
    for case in cases:
        names = [one.get("name") for one in case.iter("property")]
        assert "requirement" in names, case.get("name")


def test_every_file_of_the_suite_is_in_its_readme() -> None:
    """The table says what each file shows."""
    text = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    files = {path.name for path in EXAMPLES.glob("*.py")}
    assert files == set(re.findall(r"^\| `(\w+\.py)` \|", text, re.MULTILINE))


@pytest.mark.run
def test_the_example_of_the_reference_runs(tmp_path: Path) -> None:
    """docs/pytest.md: its first block is a whole test file."""
    shown = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "pytest.md").read_text(encoding="utf-8"), re.DOTALL)
    file = tmp_path / "test_shown.py"
    file.write_text(shown[0], encoding="utf-8")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "--strict-markers", "-p", "no:cacheprovider", str(file)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout
