"""What a target that is wrong may have meant, so that what stands beside it in the file is judged all the same.

Only a complaint that holds for everything that it may have meant is one; with a misspelt signal, '5 N m' may be right.
"""

import difflib
from dataclasses import replace
from typing import Final

from canopen_exo.plan import BusPlan
from fi_gateway.boundary import SpecError
from fi_gateway.errors import FaultError
from fi_gateway.fault_specs import FaultSpec
from fi_gateway.target import ALL_BITS, KINDS, Place, TargetSpec, resolve, service_signals, signal_names
from fi_gateway.trigger_specs import RepairSpec

_NOBODYS: Final = 0x001
"""A COB-ID of which a plan knows nothing: neither its direction nor its length."""


def complaint(spec: FaultSpec | RepairSpec, places: list[Place]) -> FaultError | None:
    """Of the first place, when the spec fits none of them."""
    errors = []
    for place in places:
        try:
            spec.build(place)
        except FaultError as error:
            errors.append(error)
        else:
            return None
    return errors[0] if errors else None


def meant(target: TargetSpec, plan: BusPlan) -> list[Place]:
    """Places like those of a target that is wrong, the one most like it first; [] when that says too little."""
    anything = TargetSpec(bus="both")
    frame = replace(anything, cob_id=(_NOBODYS, ALL_BITS))
    if target.signal is not None:
        return _places(_signals(target, anything, plan), plan)
    if target.bits is not None:
        return _places([replace(frame, bits=target.bits)], plan)
    if target.pdo is not None or target.kind is not None or target.cob_id is not None:
        pdos = [replace(anything, pdo=pdo.name) for pdo in plan.pdos]
        kinds = [replace(anything, cob_id=(base + plan.joints[0].node_id, ALL_BITS)) for base, *_ in KINDS.values()]
        return _places([frame, *pdos, *kinds], plan)
    return []


def _signals(target: TargetSpec, anything: TargetSpec, plan: BusPlan) -> list[TargetSpec]:
    """The signals of that name at every node; of a name that is nobody's, all."""
    signals = [*plan.signals(), *service_signals(plan)]
    named = [signal for signal in signals if target.signal in signal_names(signal)]
    found = {f"{signal.node}.{signal.name}": signal for signal in named or signals}
    first = difflib.get_close_matches(f"{target.node}.{target.signal}", found, n=1, cutoff=0)
    return [
        replace(anything, signal=f"{found[name].message}.{found[name].name}")
        for name in dict.fromkeys([*first, *found])
    ]


def _places(targets: list[TargetSpec], plan: BusPlan) -> list[Place]:
    places = []
    for target in targets:
        try:
            places.append(resolve(target, plan))
        except SpecError:
            continue  # bits that no frame has
    return places
