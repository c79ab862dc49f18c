"""The bus plan: which node says what, when, in which COB-ID; and the load that makes.

Source: CiA 301, 7.3.5 (predefined connection set) for the COB-IDs; the PDO contents are this project's defaults.
One plan is read by the device (its object dictionary defaults), the master (what it configures and sends),
the gateway (where a named signal lies) and the DBC export, so that they cannot disagree.
"""

import math
from dataclasses import dataclass, field
from typing import Final

from canopen_exo.errors import CanopenExoError
from canopen_exo.signal import Codec, Signal, compile_codec

NMT: Final = 0x000
SYNC: Final = 0x080
EMCY: Final = 0x080
TIME: Final = 0x100
TPDO1: Final = 0x180
RPDO1: Final = 0x200
TPDO2: Final = 0x280
HLC_STATUS: Final = 0x2FF
"""State u8, cycle u16, phase u16 from the high-level controller at time 0 and with every 10th SYNC."""
SDO_ANSWER: Final = 0x580
SDO_REQUEST: Final = 0x600
HEARTBEAT: Final = 0x700
MASTER_ID: Final = 127

STATUS_STARTING: Final = 1
"""HLC status, state byte: drives enabled, motion fading in."""
STATUS_MOTION: Final = 2
"""HLC status, state byte: time 0 has come; cycle counts the SYNCs since."""
STATUS_STOPPED: Final = 3
"""HLC status, state byte: the motion is over or was given up."""
STATUS_EVERY: Final = 10
"""An HLC status frame goes with every 10th SYNC."""


@dataclass(frozen=True, slots=True)
class Mapped:
    """One object in a PDO. length in bits; unit "" means a plain number."""

    name: str
    index: int
    sub: int
    length: int
    signed: bool
    unit: str


CONTROLWORD: Final = Mapped("controlword", 0x6040, 0, 16, False, "")
TARGET_TORQUE: Final = Mapped("target_torque", 0x6071, 0, 16, True, "N m")
POSITION: Final = Mapped("position", 0x6064, 0, 32, True, "rad")
VELOCITY: Final = Mapped("velocity", 0x606C, 0, 32, True, "rad/s")
STATUSWORD: Final = Mapped("statusword", 0x6041, 0, 16, False, "")
TORQUE: Final = Mapped("torque", 0x6077, 0, 16, True, "N m")
ERROR_CODE: Final = Mapped("error_code", 0x603F, 0, 16, False, "")


@dataclass(frozen=True, slots=True)
class Pdo:
    """A PDO as the plan has it. base: COB-ID without node id; every: sent on each n-th SYNC; name: "TPDO1"."""

    name: str
    base: int
    every: int
    content: tuple[Mapped, ...]

    def codec(self) -> Codec:
        """Packs and unpacks the raw values of the content, in order."""
        return compile_codec([(mapped.length, mapped.signed) for mapped in self.content])

    def place(self, name: str) -> int:
        """Place of an object in the content; raises CanopenExoError naming what there is."""
        for at, mapped in enumerate(self.content):
            if mapped.name == name:
                return at
        names = ", ".join(mapped.name for mapped in self.content)
        raise CanopenExoError(f"bus plan: {self.name} carries no {name!r}; it carries {names}")


PDOS: Final = (
    Pdo("RPDO1", RPDO1, 1, (CONTROLWORD, TARGET_TORQUE)),
    Pdo("TPDO1", TPDO1, 1, (POSITION, VELOCITY)),
    Pdo("TPDO2", TPDO2, 10, (STATUSWORD, TORQUE, ERROR_CODE)),
)


@dataclass(frozen=True, slots=True)
class JointNode:
    """One drive on the bus. rated_torque_mnm: object 0x6076; encoder_counts: per joint revolution (after the gear)."""

    name: str
    node_id: int
    rated_torque_mnm: int
    encoder_counts: int


@dataclass(frozen=True, slots=True)
class BusPlan:
    """Rates and nodes. cycle_ns: SYNC period; sync_counter: 0x1019 (0, 2..240; 0 = SYNC without a counter byte)."""

    joints: tuple[JointNode, ...]
    bitrate: int = 1_000_000
    cycle_ns: int = 2_000_000
    sync_counter: int = 240
    heartbeat_ns: int = 100_000_000
    pdos: tuple[Pdo, ...] = field(default=PDOS)

    def __post_init__(self) -> None:
        """Refuse what the bus cannot carry; raises CanopenExoError."""
        if self.bitrate <= 0 or 1_000_000_000 % self.bitrate:
            raise CanopenExoError(
                f"bus plan: bit rate {self.bitrate} given; allowed are rates whose bit time is a whole number of "
                "nanoseconds, such as 1000000, 800000, 500000, 250000, 125000"
            )
        for what, period in (("SYNC", self.cycle_ns), ("heartbeat", self.heartbeat_ns)):
            if period <= 0:
                raise CanopenExoError(f"bus plan: {what} period of {period} ns given, allowed is more than 0")
        if self.sync_counter == 1 or not 0 <= self.sync_counter <= 240:
            raise CanopenExoError(f"bus plan: SYNC counter {self.sync_counter} given, allowed 0 or 2..240 (CiA 301)")
        ids = [joint.node_id for joint in self.joints]
        if len(set(ids)) != len(ids) or any(not 1 <= node_id < MASTER_ID for node_id in ids):
            raise CanopenExoError(f"bus plan: node ids {ids} given, allowed are distinct ids 1..{MASTER_ID - 1}")
        low, high = self.load()
        if high > 1.0:
            raise CanopenExoError(
                f"bus plan: worst-case load {100 * high:.0f} % of {self.bitrate} bit/s at a SYNC period of "
                f"{self.cycle_ns / 1e6:g} ms ({100 * low:.0f} % without stuff bits); at most 100 % is allowed: "
                "lower the rate or map less"
            )

    def joint(self, name: str) -> JointNode:
        """The joint of that name; raises CanopenExoError naming the ones there are."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        raise CanopenExoError(f"unknown joint {name!r}; this rig has {', '.join(joint.name for joint in self.joints)}")

    def pdo(self, name: str) -> Pdo:
        """The PDO of that name; raises CanopenExoError naming the ones there are."""
        for pdo in self.pdos:
            if pdo.name == name:
                return pdo
        raise CanopenExoError(f"bus plan: no PDO {name!r}; there are {', '.join(pdo.name for pdo in self.pdos)}")

    def load(self) -> tuple[float, float]:
        """Share of the bit rate used in steady motion: (no stuff bits, every frame worst-stuffed)."""
        low, high = 0.0, 0.0
        for size, rate in self._traffic():
            low += rate * (47 + 8 * size)
            high += rate * (55 + 10 * size)
        return low / self.bitrate, high / self.bitrate

    def _traffic(self) -> list[tuple[int, float]]:
        """(payload bytes, frames a second) of everything periodic."""
        sync = 1e9 / self.cycle_ns
        traffic = [(1 if self.sync_counter else 0, sync), (5, sync / STATUS_EVERY)]
        traffic.append((1, (1 + len(self.joints)) * 1e9 / self.heartbeat_ns))
        for pdo in self.pdos:
            size = (sum(mapped.length for mapped in pdo.content) + 7) // 8
            traffic.append((size, len(self.joints) * sync / pdo.every))
        return traffic

    def scale(self, joint: JointNode, unit: str) -> float:
        """SI value of one raw unit of an object of that SI unit: counts, counts/s, per mille of rated torque."""
        if unit == "N m":
            return joint.rated_torque_mnm / 1_000_000  # 0x6071 and 0x6077 count per mille of 0x6076 (CiA 402-2)
        if unit in ("rad", "rad/s"):
            return 2 * math.pi / joint.encoder_counts
        return 1.0

    def signals(self) -> list[Signal]:
        """Every mapped value of every joint, in node and PDO order."""
        found = []
        for joint in self.joints:
            for pdo in self.pdos:
                start = 0
                for mapped in pdo.content:
                    found.append(
                        Signal(
                            mapped.name,
                            joint.name,
                            f"{joint.name}_{pdo.name}",
                            pdo.base + joint.node_id,
                            start,
                            mapped.length,
                            mapped.signed,
                            self.scale(joint, mapped.unit),
                            mapped.unit,
                            mapped.index,
                            mapped.sub,
                        )
                    )
                    start += mapped.length
        return found
