"""The base error of this package, and the one that a caller must tell from it."""


class BenchError(Exception):
    """A request this package refuses; the message says what, where, what was given, what is allowed and the remedy."""


class RefusedError(BenchError):
    """An address or a bus that was given cannot be had: no fault of a run, as none has begun."""
