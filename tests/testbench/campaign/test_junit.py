"""JUnit XML: what continuous integration reads of a campaign."""

from xml.etree.ElementTree import Element, fromstring

import pytest

from testbench.campaign.records import Outcome
from testbench.campaign.report.junit import junit_text
from tests.testbench.campaign.made_rows import axis, meta, point, row

HERE, THERE, NEVER = point(duration="0.1 s"), point(duration="0.2 s"), point(duration="0.3 s")
ROWS = [
    row(HERE, 0, Outcome.MASKED, wall_s=1.5),
    row(HERE, 1, Outcome.FAILURE_SILENT, wall_s=2.0),
    row(HERE, 2, Outcome.ERROR),
    row(HERE, 3, Outcome.ERROR),
    row(THERE, 0, Outcome.FAILURE_DETECTED),
    row(THERE, 1, Outcome.HANG, reason="did not end within 120 s"),
    row(THERE, 2, Outcome.CRASHED, reason="\x00 <died> \ud800"),
]
META = meta([axis("duration", "0.1 s", "0.2 s", "0.3 s")], [HERE, THERE, NEVER], name='a "name" <&>')


@pytest.fixture(scope="module")
def document() -> Element:
    return fromstring(junit_text(ROWS, META))


def properties(suite: Element) -> dict[str, str]:
    return {one.attrib["name"]: one.attrib["value"] for one in suite.iterfind("properties/property")}


def test_each_point_is_one_case(document: Element) -> None:
    """One test case a point, named as the point, in a suite of its own, whose properties are in the common schema."""
    cases = [suite.findall("testcase") for suite in document.iterfind("testsuite")]
    assert [len(found) for found in cases] == [1, 1, 1]
    assert [found[0].attrib["name"] for found in cases] == ["duration 0.1 s", "duration 0.2 s", "duration 0.3 s"]
    assert {found[0].attrib["classname"] for found in cases} == {'a "name" <&>'}


def test_totals_are_the_sums_of_the_suites(document: Element) -> None:
    """Readers take counts from the top."""
    suites = document.findall("testsuite")
    for key in ("tests", "failures", "errors"):
        assert int(document.attrib[key]) == sum(int(suite.attrib[key]) for suite in suites)
    assert document.attrib["errors"] == "1"
    assert float(suites[0].attrib["time"]) == pytest.approx(5.5)


def test_runs_without_statement_make_an_error(document: Element) -> None:
    """They prove nothing, and say why; a run that failed is a result and no error."""
    fine, mute, missing = document.findall("testsuite/testcase")
    assert [child.tag for child in fine] == []
    (error,) = mute
    assert error.tag == "error"
    assert error.attrib == {"type": "crashed and hang", "message": "2 of 3 runs make no statement"}
    assert "run 1, seed 2: hang: did not end within 120 s" in (error.text or "")
    assert [child.tag for child in missing] == ["skipped"]


def test_characters_xml_cannot_hold_are_replaced(document: Element) -> None:
    """XML 1.0, 2.2: a NUL or half a surrogate pair in a reason would make the file unreadable."""
    (error,) = document.iterfind("testsuite/testcase/error")
    assert "crashed: \ufffd <died> \ufffd" in (error.text or "")


def test_shares_are_over_runs_that_make_a_statement(document: Element) -> None:
    """Shares with their intervals are properties; a point without runs has none. Wilson, 1 of 4: 0.0456 to 0.6994."""
    here, there, missing = (properties(suite) for suite in document.iterfind("testsuite"))
    assert (here["share.failure"], here["share.exceeded"]) == ("0.25", "0.75")
    assert float(here["share.failure.low"]) == pytest.approx(0.0456, abs=1e-4)
    assert float(here["share.failure.high"]) == pytest.approx(0.6994, abs=1e-4)
    assert (there["runs"], there["runs_with_statement"], there["share.failure"]) == ("3", "1", "1")
    assert "share.failure" not in missing
