"""Where an active fault sends what does not simply go on: later frames, and further ones."""

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import Frame


@mypyc_attr(allow_interpreted_subclasses=True)
class Outlet:
    """Where an active fault sends what does not simply go on.

    One per injector and direction; given per call, never kept.
    """

    def later(self, at_ns: int, frame: Frame, in_order: bool) -> None:
        """`frame` goes on at `at_ns` (>= now) from behind this injector: those written after it act on it then.

        in_order: frames of its COB-ID that arrive until then wait behind it, also after the window has closed.
        """
        raise NotImplementedError

    def insert(self, frame: Frame) -> None:
        """A further frame, at once, before whatever `apply` returns; from behind this injector as well."""
        raise NotImplementedError
