"""The one base error of this package."""


class JointEmulatorError(Exception):
    """A request or a state this package refuses; the message says what, where, what was given and the remedy."""
