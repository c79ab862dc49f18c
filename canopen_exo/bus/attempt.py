"""An attempt that the bit engine works out: who takes part, and what came of it, as steps in their order.

Source: see `controller`. A frame counts as received at the end of its intermission, as on an undisturbed bus, although
a receiver accepts it with the last but one bit of EOF, four bits before.
"""

from typing import Final, final

from canopen_exo.bus.controller import ACCEPT_TO_END, Controller, Detected
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Port
from canopen_exo.bus.recovery import is_present

COUNT: Final = 0
ERROR: Final = 1
FRAME: Final = 2
END: Final = 3


@final
class Step:
    """Something that happens within an attempt, after bit `at`.

    COUNT: the counters of `port` are tec and rec. ERROR: `port` was the first to notice `error`, or to send an overload
    frame. FRAME: `frame`, sent by `port`, was accepted by `ports`. END: the next attempt may begin.
    """

    __slots__ = ("at", "error", "frame", "kind", "port", "ports", "rec", "tec")

    def __init__(
        self, at: int, kind: int, port: Port, tec: int = 0, rec: int = 0,
        frame: Frame | None = None, ports: list[Port] | None = None, error: Detected | None = None,
    ) -> None:  # fmt: skip
        self.at: Final[int] = at
        self.kind: Final[int] = kind
        self.port: Final[Port] = port
        self.tec: Final[int] = tec
        self.rec: Final[int] = rec
        self.frame: Final[Frame | None] = frame
        self.ports: Final[list[Port]] = [] if ports is None else ports
        self.error: Final[Detected | None] = error

    def __reduce__(
        self,
    ) -> tuple[type["Step"], tuple[int, int, Port, int, int, Frame | None, list[Port], Detected | None]]:
        return Step, (self.at, self.kind, self.port, self.tec, self.rec, self.frame, self.ports, self.error)


def put_back(waiting: list[tuple[Frame, Port]], frame: Frame, port: Port) -> None:
    """A frame under way that was taken for undisturbed, back among those that wait: before those of its id."""
    at = 0
    while at < len(waiting) and waiting[at][0].arbitration < frame.arbitration:
        at += 1
    waiting.insert(at, (frame, port))


def controllers_of(
    offers: list[tuple[Frame, Port]], unsettled: list[Controller], ports: list[Port], late: int = 0
) -> list[Controller]:
    """Who takes part: senders of the offers, last one first, then receivers; ports: of the medium, by number.

    unsettled: those that have not come to rest after an earlier error; they go on from where they were.
    late: mask of ports that do not take part yet.
    """
    controllers: list[Controller] = []
    known = late
    sending = 0
    for _, port in offers:
        sending |= 1 << port.number
    for controller in unsettled:
        others = [number for number in controller.ports if not sending >> number & 1]
        if others:
            controllers.append(controller.part(others))
        for number in controller.ports:
            known |= 1 << number
    for frame, port in offers:
        sender = Controller([port.number], port.tec, port.rec)
        for controller in unsettled:
            if port.number in controller.ports:
                sender = controller.part([port.number])
        sender.send(frame)
        controllers.insert(0, sender)
        known |= 1 << port.number
    alike: dict[tuple[int, int], list[int]] = {}
    for port in ports:
        if not known >> port.number & 1 and is_present(port):
            alike.setdefault((port.tec, port.rec), []).append(port.number)
    for counters, numbers in alike.items():
        controllers.append(Controller(numbers, counters[0], counters[1]))
    return controllers


def steps_of(controllers: list[Controller], bits: int, ports: list[Port]) -> list[Step]:
    """The steps of an attempt of so many bits; ports: of the medium, by number."""
    steps: list[Step] = []
    for controller in controllers:
        for counted in controller.counted:
            for number in controller.ports:
                steps.append(Step(counted.at, COUNT, ports[number], counted.tec, counted.rec))
    _note_first(controllers, ports, steps, False)
    _note_first(controllers, ports, steps, True)
    _note_frames(controllers, ports, steps)
    steps.append(Step(bits - 1, END, ports[controllers[0].ports[0]]))
    steps.sort(key=_order)
    return steps


def _note_first(controllers: list[Controller], ports: list[Port], steps: list[Step], of_overloads: bool) -> None:
    """The first error of the attempt that somebody noticed, or the first overload; of several at once the sender's."""
    found: Detected | None = None
    number = 0
    for controller in controllers:
        notices = controller.overloads if of_overloads else controller.found
        if notices:
            first = notices[0]
            if found is None or (first.at, not first.transmitting) < (found.at, not found.transmitting):
                found, number = first, controller.ports[0]
    if found is not None:
        steps.append(Step(found.at, ERROR, ports[number], error=found))


def _sender(controllers: list[Controller]) -> Controller | None:
    """Whose frame it was: of several that began the one that got through, or at least did not lose arbitration."""
    best: Controller | None = None
    for controller in controllers:
        if controller.sent_at >= 0:
            return controller
        if controller.frame is not None and (best is None or controller.has_failed):
            best = controller
    return best


def _note_frames(controllers: list[Controller], ports: list[Port], steps: list[Step]) -> None:
    """A step for every frame that was accepted, as those who accepted it understood it."""
    sender = _sender(controllers)
    if sender is None or sender.frame is None:
        return
    port = ports[sender.ports[0]]
    accepted: list[Step] = []
    for controller in controllers:
        frame = controller.accepted
        if frame is None:
            continue
        if frame == sender.frame:
            frame = sender.frame
        at = controller.accepted_at + ACCEPT_TO_END - 1
        accepting = [ports[number] for number in controller.ports]
        for step in accepted:
            if step.at == at and step.frame == frame:
                step.ports.extend(accepting)
                break
        else:
            accepted.append(Step(at, FRAME, port, frame=frame, ports=accepting))
    if not accepted and sender.sent_at >= 0:
        accepted.append(Step(sender.sent_at + ACCEPT_TO_END - 2, FRAME, port, frame=sender.frame))
    steps.extend(accepted)


def _order(step: Step) -> tuple[int, int, int]:
    return step.at, step.kind, step.port.number
