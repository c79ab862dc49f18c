"""The state of a random stream as text: what is drawn after it is restored is what was drawn after it was taken."""

import pytest
from numpy.random import MT19937, PCG64, Generator

from fi_gateway.errors import FaultError
from fi_gateway.injector import stream
from fi_gateway.rng_state import restore, state_of


@pytest.mark.parametrize("drawn", range(4))
def test_restored_stream_draws_the_same_again(drawn: int) -> None:
    """Also in the middle of a 64-bit word, of which 32-bit draws take one half at a time."""
    rng = stream(2020, 0, "x")
    rng.normal(size=5)
    rng.integers(1000, size=drawn, dtype="uint32")
    state = state_of(rng)
    wanted = (rng.integers(1000, size=3, dtype="uint32").tolist(), rng.random(), rng.geometric(0.01))
    other = Generator(PCG64(99))
    restore(other, state)
    assert state_of(other) == state
    assert (other.integers(1000, size=3, dtype="uint32").tolist(), other.random(), other.geometric(0.01)) == wanted


def test_taking_the_state_draws_nothing() -> None:
    """Recording must not change what is recorded."""
    rng, same = stream(1, 0, "x"), stream(1, 0, "x")
    assert state_of(rng) == state_of(rng)
    assert rng.random() == same.random()


WIDE = "f" * 40


@pytest.mark.parametrize(
    "text", ["", "1.2.3", "1.2.0.0.0", "x.1.0.0", f"1.1.0.{WIDE}", f"{WIDE}.1.0.0", f"1.{WIDE}.0.0", "-1.1.0.0"]
)
def test_text_that_is_no_state_is_refused(text: str) -> None:
    """Somebody may have edited the record."""
    with pytest.raises(FaultError, match="random stream: state"):
        restore(Generator(PCG64(1)), text)


def test_other_generators_are_refused() -> None:
    """The streams of injectors are PCG64; the state of another one has another form."""
    with pytest.raises(FaultError):
        restore(Generator(MT19937(1)), state_of(Generator(PCG64(1))))
