"""Faults in files that put frames on the bus which nobody sent like this."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from canopen_exo.bus.frame import Frame
from fi_gateway.boundary import Flag, Span, SpecError, Whole
from fi_gateway.fault_specs.base import AnyPayload, CobId, FaultSpec, no_signal
from fi_gateway.faults import CorruptDlc, Fault, Insert, Masquerade
from fi_gateway.quantity import format_duration
from fi_gateway.target import Place


@dataclass(frozen=True, slots=True)
class InsertSpec(FaultSpec):
    """A further frame: `every` so often, or ahead of each target frame; its COB-ID is the target's by default."""

    type: Literal["insert"]
    payload: AnyPayload
    cob_id: CobId | None = None
    every_ns: Annotated[Span | None, Field(alias="every")] = None

    def build(self, place: Place) -> Fault:
        """See Insert."""
        no_signal(place, "insert adds whole frames")
        if self.every_ns is not None and place.to_controller and place.to_drives:
            raise SpecError(
                ("every",), "in which direction? a target with bus: both has two; write to_controller or to_drives"
            )
        return Insert(Frame(self._id(place), bytes.fromhex(self.payload)), self.every_ns or 0)

    def needs_frames(self) -> bool:
        """Not with `every`."""
        return self.every_ns is None

    def _id(self, place: Place) -> int:
        if self.cob_id is not None:
            return self.cob_id
        if len(place.cob_ids) > 1:
            raise SpecError((), f"cob_id is missing: {place.words} has {len(place.cob_ids)} of them; say which to send")
        return place.cob_ids[0]

    def words(self, place: Place) -> str:
        """For people."""
        when = f"every {format_duration(self.every_ns)}" if self.every_ns is not None else "ahead of each"
        frame = f"{self._id(place):03X}#{self.payload.replace(' ', '')}"
        return f"joined by further frames {frame}, {when},"


@dataclass(frozen=True, slots=True)
class MasqueradeSpec(FaultSpec):
    """The frame passes for another one: it goes on with another COB-ID; with `copy` the genuine one as well."""

    type: Literal["masquerade"]
    cob_id: Annotated[CobId, Field(alias="as")]
    copy: Flag = False

    def build(self, place: Place) -> Fault:
        """See Masquerade."""
        no_signal(place, "masquerade changes the COB-ID of whole frames")
        if place.cob_ids == (self.cob_id,):
            raise SpecError(("as",), f"{self.cob_id:#05x} is the target's own COB-ID; give another one")
        return Masquerade(self.cob_id, self.copy)

    def words(self, place: Place) -> str:
        """For people."""
        return f"{'also ' if self.copy else ''}passed on as 0x{self.cob_id:03X}"


@dataclass(frozen=True, slots=True)
class CorruptDlcSpec(FaultSpec):
    """The frame gets another length: the given DLC, or a random one of 0..8 for every frame."""

    type: Literal["corrupt_dlc"]
    dlc: Annotated[Whole, Field(ge=0, le=15)] | None = None

    def build(self, place: Place) -> Fault:
        """See CorruptDlc."""
        no_signal(place, "corrupt_dlc changes the length of whole frames")
        if self.dlc is not None and self.dlc == place.size:
            raise SpecError(("dlc",), f"{place.words} has that DLC already; give another one")
        return CorruptDlc(-1 if self.dlc is None else self.dlc)

    def words(self, place: Place) -> str:
        """For people."""
        return "cut or filled to a random DLC" if self.dlc is None else f"sent with DLC {self.dlc}"
