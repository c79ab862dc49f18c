"""The one base error of this package."""


class FaultError(Exception):
    """A request this package refuses; the message says what, where, what was given, what is allowed and the remedy."""
