"""CAN controllers on a wired-AND bus, bit by bit: an attempt to send a frame, with its error and overload frames.

Source: ISO 11898-1 (Bosch CAN 2.0 part B). Pure computation: `run` takes the controllers and what disturbs the bits.
"""

from typing import Final

from canopen_exo.bus.controller import IDLE, OFF, Controller
from canopen_exo.bus.disturbance import ALL, DOMINANT, FLIP, NO_ACK, Disruption

_FAR: Final = 1 << 20
"""A bit that no attempt reaches."""


def split(controllers: list[Controller], disruptions: list[Disruption]) -> list[Controller]:
    """Controllers whose ports do not all see the same become several."""
    local: list[int] = []
    for disruption in disruptions:
        if disruption.ports != ALL and disruption.ports not in local:
            local.append(disruption.ports)
    if not local:
        return controllers
    found: list[Controller] = []
    for controller in controllers:
        views: dict[int, list[int]] = {}
        for port in controller.ports:
            view = 0
            for mask in local:
                view = view << 1 | (mask >> port & 1)
            views.setdefault(view, []).append(port)
        if len(views) == 1:
            found.append(controller)
        else:
            for view in views:
                found.append(controller.part(views[view]))
    return found


def run(controllers: list[Controller], disruptions: list[Disruption], limit: int) -> int:
    """Bit by bit until the bus is idle for one of them and nobody sends; returns the number of bits, at most `limit`.

    controllers: as given by `split`. Those that are not idle afterwards go on with the next attempt.
    """
    acting: list[Disruption] = []
    quiet_until, quiet_from = _FAR, 0
    for disruption in disruptions:
        if disruption.kind == NO_ACK:
            for controller in controllers:
                if _sees(disruption, controller):
                    controller.refuse_acknowledge()
        elif disruption.end > 0:
            acting.append(disruption)
            quiet_until = min(quiet_until, disruption.first)
            quiet_from = max(quiet_from, disruption.end)
    for at in range(limit):
        bus = 1
        for controller in controllers:
            if controller.out == 0:
                bus = 0
        busy = finished = False
        disturbed = quiet_until <= at < quiet_from
        for controller in controllers:
            controller.step(at, _view(acting, at, controller, bus) if disturbed else bus)
            if controller.idle_at == at:
                finished = True
            if controller.state != IDLE and controller.state != OFF:
                busy = True
        if not busy:
            return at + 1
        if finished:
            for controller in controllers:
                finished = finished and not controller.is_sending
            if finished:
                return at + 1
    return limit


def _sees(disruption: Disruption, controller: Controller) -> bool:
    return disruption.ports >> controller.ports[0] & 1 == 1


def _view(acting: list[Disruption], at: int, controller: Controller, bus: int) -> int:
    """What a controller sees of a bit."""
    seen = bus
    for disruption in acting:
        if disruption.kind == DOMINANT and disruption.first <= at < disruption.end and _sees(disruption, controller):
            seen = 0
    for disruption in acting:
        if disruption.kind == FLIP and disruption.first <= at < disruption.end and _sees(disruption, controller):
            seen = 1 - seen
    return seen
