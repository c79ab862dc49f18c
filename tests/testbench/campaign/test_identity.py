"""Which run is which: scenario, seed, program, early stop; and nothing else."""

import pytest

from testbench.campaign.making.identity import code_version, identity, with_seed
from testbench.errors import BenchError


def test_everything_that_changes_a_run_changes_its_identity() -> None:
    """Fixed here, so that a change of the rule itself is seen; it would make every store start anew."""
    base = ("name: a\nseed: 0\n", 1, "0.1.0+0", "failure", 0.25)
    others: list[tuple[str, int, str, str | None, float]]
    others = [("name: b\nseed: 0\n", *base[1:]), (base[0], 2, *base[2:]), (*base[:2], "0.1.0+1", *base[3:])]
    others += [(*base[:3], None, 0.25), (*base[:4], 0.5)]
    names = [identity(*given) for given in (base, *others)]
    assert len(set(names)) == len(names)
    assert names[0] == "d947bf7757944691f5ff23faf3e2dfa604b5c010d82ed490ec8da7ff7f16c686"
    assert identity(*base[:3], None, 1.0) == identity(*base[:3], None, 2.0)  # no early stop, no grace


def test_code_version_names_release_and_sources() -> None:
    """The release, and twelve digits over all sources; the same when asked again."""
    release, _, digits = code_version().partition("+")
    assert release == "0.1.0"
    assert len(digits) == 12
    assert int(digits, 16) >= 0
    assert code_version() == code_version()


def test_seed_goes_into_the_scenario() -> None:
    """At its line, and nowhere else."""
    assert with_seed("name: a\nseed: 0\nx: 'seed: 0'\n", 42) == "name: a\nseed: 42\nx: 'seed: 0'\n"
    with pytest.raises(BenchError, match="without the line 'seed: 0'"):
        with_seed("name: a\nseed: 1\n", 42)
