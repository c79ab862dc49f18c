"""Faults as a scenario file gives them: one small class each, and the registry of all (`FAULTS`).

Each reads its own keys, builds the engine's fault, and says in words what it does. `build` raises SpecError when the
values do not fit the target. Further ones come from other packages, see `fi_gateway.kinds` and docs/faults.md.
"""

from typing import Annotated, Final, TypeAlias

from fi_gateway.fault_specs.base import CobId, FaultSpec, Payload, Ratio, Scalar, needed_signal, raw_value
from fi_gateway.fault_specs.bits import BitFlipSpec, BitStuckSpec
from fi_gateway.fault_specs.forgery import CorruptDlcSpec, InsertSpec, MasqueradeSpec
from fi_gateway.fault_specs.hold import PackageDropSpec, StuckAtSpec, StuckAtValueSpec, TimeDelaySpec
from fi_gateway.fault_specs.passage import DelaySpec, DropSpec, DuplicateSpec, ReplaySpec, ResequenceSpec
from fi_gateway.fault_specs.value import BiasSpec, DriftSpec, GainSpec, NoiseSpec
from fi_gateway.fault_specs.wire import (
    BabblingIdiotSpec,
    BitErrorRateSpec,
    BitErrorSpec,
    BusOffSpec,
    GilbertElliottSpec,
    NoAckSpec,
    StuckDominantSpec,
    WireFaultSpec,
)
from fi_gateway.kinds import Kinds

FAULTS: Final = Kinds(
    "fault",
    "exo_hil.faults",
    FaultSpec,
    (
        StuckAtSpec,
        StuckAtValueSpec,
        PackageDropSpec,
        TimeDelaySpec,
        BiasSpec,
        GainSpec,
        DriftSpec,
        NoiseSpec,
        BitFlipSpec,
        BitStuckSpec,
        DropSpec,
        DelaySpec,
        ResequenceSpec,
        DuplicateSpec,
        ReplaySpec,
        InsertSpec,
        MasqueradeSpec,
        CorruptDlcSpec,
        BitErrorSpec,
        StuckDominantSpec,
        NoAckSpec,
        BitErrorRateSpec,
        GilbertElliottSpec,
        BusOffSpec,
        BabblingIdiotSpec,
    ),
)

FaultChoice: TypeAlias = Annotated[FaultSpec, FAULTS]

__all__ = [
    "FAULTS",
    "CobId",
    "FaultChoice",
    "FaultSpec",
    "Payload",
    "Ratio",
    "Scalar",
    "WireFaultSpec",
    "needed_signal",
    "raw_value",
]
