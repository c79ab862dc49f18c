"""`exo-hil hub --errors`: its options, and the buses it makes."""

import pytest

from canopen_exo.bus.hub_errors import ErrorBus
from fi_gateway.wire_faults import BitErrorRate
from testbench.cli import main
from testbench.noisy_hub import bus_maker


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--errors"], "--errors needs --timed"),
        (["--timed", "--bit-error-rate", "1e-5"], "--bit-error-rate needs --errors"),
        (["--timed", "--errors", "--bit-error-rate", "0"], "--bit-error-rate 0 given, allowed above 0 up to 1"),
        (["--timed", "--errors", "--bit-error-rate", "2"], "--bit-error-rate 2 given"),
    ],
)
def test_options_that_do_not_fit_are_a_usage_error(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2, one line."""
    assert main(["hub", "--listen", "127.0.0.1:0", *arguments]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1


def test_bus_without_a_rate_has_no_noise() -> None:
    """Errors are possible all the same: nobody acknowledges a lone client."""
    bus = bus_maker(None, 1)("drive", 0, 1_000_000, 0)
    assert isinstance(bus, ErrorBus)
    assert bus.wire.disturbances == []


def test_noise_follows_from_seed_and_bus_name() -> None:
    """One stream per name: another bus more or less changes none."""

    def first(seed: int, name: str) -> int:
        bus = bus_maker(1e-5, seed)(name, 0, 500_000, 7_000)
        assert isinstance(bus, ErrorBus)
        (noise,) = bus.wire.disturbances
        assert isinstance(noise, BitErrorRate)
        assert (noise.bit_ns, noise.rate, noise.since) == (2_000, 1e-5, 7_000)
        return noise.next_ns(7_000)

    assert first(1, "drive") == first(1, "drive")
    assert len({first(1, "drive"), first(2, "drive"), first(1, "controller")}) == 3
