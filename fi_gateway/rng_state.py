"""The state of a random stream as text, so that a record can say where in its stream an activation stood."""

from numpy.random import PCG64, Generator

from fi_gateway.errors import FaultError


def state_of(rng: Generator) -> str:
    """The state of a PCG64 stream, "state.increment.has_uint32.uinteger" in hexadecimal digits."""
    found = rng.bit_generator.state
    inner = found["state"]
    return f"{inner['state']:x}.{inner['inc']:x}.{found['has_uint32']:x}.{found['uinteger']:x}"


def restore(rng: Generator, text: str) -> None:
    """Put the stream where `text` says. Raises FaultError when that is no state of a PCG64 stream."""
    try:
        state, inc, has_uint32, uinteger = (int(part, 16) for part in text.split("."))
        rng.bit_generator.state = {
            "bit_generator": PCG64.__name__,
            "state": {"state": state, "inc": inc},
            "has_uint32": has_uint32,
            "uinteger": uinteger,
        }
    except (ValueError, OverflowError) as error:
        allowed = "allowed is one as recorded with an activation"
        raise FaultError(f"random stream: state {text!r} given, {allowed}") from error
