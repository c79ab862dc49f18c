"""Injectors given to a rig that is there already: read and checked as in a scenario file, together with the others.

Left out: changing or removing an injector; `disarm` (live control) makes one silent.
"""

import contextlib
from collections.abc import Mapping
from typing import Final, final

from canopen_exo.plan import BusPlan
from fi_gateway.boundary import dump, validate
from fi_gateway.errors import FaultError
from fi_gateway.fault_specs import WireFaultSpec
from fi_gateway.gateway import WIRE_LATE, Gateway
from fi_gateway.injector import Injector
from fi_gateway.marked_yaml import Data, Document, Keys, dotted
from fi_gateway.schema import InjectorSpec, build_injector, build_injectors, check_injectors

_FIRST: Final[Data] = {
    "target": {"bus": "to_drives", "pdo": "RPDO1"},
    "fault": {"type": "drop"},
    "event": {"type": "never"},
    "effect": {"type": "once"},
}


@final
class Additions:
    """The injectors of one rig, and more of them. specs: by name, in the order in which they act; seed: of the run."""

    def __init__(self, specs: Mapping[str, InjectorSpec], plan: BusPlan, seed: int) -> None:
        self.specs: dict[str, InjectorSpec] = dict(specs)
        self._plan: Final[BusPlan] = plan
        self._seed: Final[int] = seed

    def prepare(self) -> None:
        """Prepare the checks, which takes 0.1 s the first time: while a gateway reads an injector, no frame passes."""
        with contextlib.suppress(FaultError):
            first = read_injector("first", _FIRST, {}, self._plan)
            read_injector("second", _FIRST, {"first": first, **self.specs}, self._plan)

    def read(self, name: str, given: object) -> None:
        """One more, for a gateway to be made. given: its keys in a scenario file. FaultError has all complaints."""
        self.specs = self._with(name, given)

    def extend(self, gateway: Gateway, name: str, given: object, now: int, at_once: bool) -> None:
        """One more in a gateway that is there, see `Gateway.add`. Raises FaultError."""
        specs = self._with(name, given)
        if isinstance(specs[name].fault, WireFaultSpec):
            raise FaultError(f"injector {name}: {WIRE_LATE}")
        gateway.add(build_injector(name, specs[name], self._plan, self._seed, 0), now, at_once)
        self.specs = specs

    def built(self) -> list[Injector]:
        """The engine's injectors, each with its own random stream, as in a run of a file that has them all."""
        return build_injectors(self.specs, self._plan, self._seed, 0)

    def _with(self, name: str, given: object) -> dict[str, InjectorSpec]:
        return {**self.specs, name: read_injector(name, plain(given), self.specs, self._plan)}


def read_injector(name: str, given: Data, others: Mapping[str, InjectorSpec], plan: BusPlan) -> InjectorSpec:
    """The injector in plain data; raises FaultError."""
    document = Document(f"injector {name}", given)
    if name in others:
        document.report((), "the name is taken; give another one")
    spec = validate(InjectorSpec, given, (), document)

    def report(keys: Keys, text: str) -> None:
        if keys[0] == name:
            document.report(keys[1:], text)

    check_injectors({**{one: dump(InjectorSpec, spec) for one, spec in others.items()}, name: given}, plan, report)
    if spec is None or document.problems:
        places = ((f"{dotted(one.keys)}: " if one.keys else "", one.text) for one in document.problems)
        raise FaultError("\n".join(dict.fromkeys(f"injector {name}: {place}{text}" for place, text in places)))
    return spec


def plain(given: object) -> Data:
    """Python values, or JSON, as a file would hold them; what a file cannot hold is left for the schema to refuse."""
    if isinstance(given, Mapping):
        return {str(key): plain(value) for key, value in given.items()}
    if isinstance(given, list | tuple):
        return [plain(value) for value in given]
    if given is None or isinstance(given, str | int | float):
        return given
    return repr(given)
