"""Faults injected by a test: the keys of a scenario file as Python values, read and checked by the same schema.

    exo.gateway.inject(
        target={"bus": "to_controller", "node": "right_knee", "signal": "position"},
        fault={"type": "bias", "value": "0.05 rad"},
        duration="0.3 s",
    )

Without an event (and without a trigger) the fault begins at once: at the time of the call, or with the first frame when
the rig has not run yet.
"""

from collections.abc import Mapping
from typing import Final, final

from fi_gateway.addition import Additions
from fi_gateway.control import InjectorRow
from fi_gateway.errors import FaultError
from fi_gateway.phase import ACTIVE
from testbench.errors import BenchError
from testbench.scenario import Scenario

Part = Mapping[str, object]
"""A part of an injector as in a scenario file."""

NOT_RUN: Final = "{what}: the rig has not run yet; run_for() or run_until_motion() first"

_NOW: Final[Part] = {"type": "at", "time": "0 s"}


class GatewayControl:
    """The gateway of a rig: base class, one for each kind of rig. additions: all injectors so far."""

    def __init__(self, scenario: Scenario) -> None:
        self.additions: Final[Additions] = Additions(scenario.injectors, scenario.plan, scenario.seed)

    def inject(
        self,
        *,
        target: Part,
        fault: Part,
        event: Part | None = None,
        effect: Part | None = None,
        duration: str | None = None,
        trigger: Part | None = None,
        start: str | None = None,
        name: str = "",
    ) -> "Injection":
        """Add an injector, before the rig runs or while it runs; keys as in a scenario file.

        duration: for `effect: {type: constant_time, duration: ...}`; without either the fault lasts until the run ends.
        start: the file's `from`, time_zero (default) or power_up; for an event only.
        Raises FaultError naming every wrong key.
        """
        name = name or self._free_name()
        at_once = event is None and trigger is None
        if effect is not None and duration is not None:
            raise FaultError(f"injector {name}: effect and duration given; duration stands for one, leave one out")
        if at_once and start is not None:
            raise FaultError(f"injector {name}: start given without an event; without one the fault begins at once")
        if effect is None:
            effect = {"type": "infinite"} if duration is None else {"type": "constant_time", "duration": duration}
        if event is None:
            event = _NOW if at_once else {"type": "never"}
        given: dict[str, object] = {"target": target, "fault": fault, "event": event, "effect": effect}
        if trigger is not None:
            given["trigger"] = trigger
        if start is not None or at_once:
            given["from"] = start or "power_up"
        self._add(name, given, at_once)
        return Injection(self, name)

    def injection(self, name: str) -> "Injection":
        """An injector of the scenario, or one added before; raises FaultError naming those there are."""
        specs = self.additions.specs
        if name not in specs:
            raise FaultError(f"no injector {name!r}; there are: {', '.join(specs) or 'none'}")
        return Injection(self, name)

    def start(self) -> None:
        """Time 0 is now, for a foreign controller that does not say it on the bus: from now on injectors act."""
        self.command("start", "")

    def stop(self) -> None:
        """End all faults; every frame passes until `resume`."""
        self.command("stop", "")

    def resume(self) -> None:
        """Inject again."""
        self.command("resume", "")

    def listing(self) -> list[InjectorRow]:
        """All injectors as they are now, in the order in which they act; empty before the rig runs."""
        raise NotImplementedError

    def command(self, word: str, name: str) -> None:
        """A word of live control (docs/live_control.md); name: "" for those about the gateway. Raises FaultError."""
        raise NotImplementedError

    def _add(self, name: str, given: Part, at_once: bool) -> None:
        """Take a new injector into the rig. at_once: its event is now."""
        raise NotImplementedError

    def _free_name(self) -> str:
        number = 1
        while f"injection_{number}" in self.additions.specs:
            number += 1
        return f"injection_{number}"


@final
class Injection:
    """One injector of a rig, by name."""

    def __init__(self, gateway: GatewayControl, name: str) -> None:
        self.name: Final[str] = name
        self._gateway: Final[GatewayControl] = gateway

    @property
    def row(self) -> InjectorRow:
        """As it is now: state, activated (windows opened), injected (frames acted on), manifested (frames changed)."""
        for row in self._gateway.listing():
            if row.name == self.name:
                return row
        raise BenchError(f"injector {self.name}: the rig has not run yet, so there is nothing to say of it")

    @property
    def is_active(self) -> bool:
        """Whether its window is open now."""
        return self.row.state == ACTIVE.value

    def trigger(self) -> None:
        """Open its window now; ignored while it is open."""
        self._gateway.command("trigger", self.name)

    def arm(self) -> None:
        """Let it wait for its event and trigger, also when it is spent or disarmed."""
        self._gateway.command("arm", self.name)

    def disarm(self) -> None:
        """Close its window, and open none until it is armed."""
        self._gateway.command("disarm", self.name)
