"""`expect:` lines of a scenario: a quantity of the result, a comparison, a value with its unit.

Quantities (values in SI after reading):

    errors, failures, injections, manifested        counts over the 7 s (or however long the motion is); injections are
                                                    activations, manifested what they changed (testbench.document)
    completed                                       1 when the whole motion was walked, 0 when it was ended early
    golden.tracking_rmse [.JOINT]                   angle: reference against fault-free plant; without a joint the worst
    joints.JOINT.rmse_position | rmse_velocity | rmse_torque      faulted against golden
    joints.JOINT.min_angle | max_angle | max_speed | max_torque   extremes of the faulted run
"""

import re
from dataclasses import dataclass
from typing import Final

from fi_gateway.marked_yaml import did_you_mean
from fi_gateway.quantity import Dimension, describe_value, parse_quantity

COUNTS: Final = ("errors", "failures", "injections", "manifested", "completed")
TRACKING: Final = "golden.tracking_rmse"
JOINT_QUANTITIES: Final = {
    "rmse_position": Dimension.ANGLE,
    "rmse_velocity": Dimension.SPEED,
    "rmse_torque": Dimension.TORQUE,
    "min_angle": Dimension.ANGLE,
    "max_angle": Dimension.ANGLE,
    "max_speed": Dimension.SPEED,
    "max_torque": Dimension.TORQUE,
}

_LINE: Final = re.compile(r"\s*([A-Za-z_][A-Za-z0-9_.]*)\s*(<=|>=|==|!=|<|>)\s*(\S.*?)\s*", re.ASCII)
_COUNT: Final = re.compile(r"[0-9]{1,9}", re.ASCII)


@dataclass(frozen=True, slots=True)
class Expectation:
    """One line. path: the quantity; operator: < <= > >= == !=; value: SI, or a count; text: the line as written."""

    path: str
    operator: str
    value: float
    text: str


def quantities(joint_names: tuple[str, ...]) -> dict[str, Dimension | None]:
    """Every quantity a line may name, with what it measures; None for a count."""
    known: dict[str, Dimension | None] = dict.fromkeys(COUNTS)
    known[TRACKING] = Dimension.ANGLE
    for joint in joint_names:
        known[f"{TRACKING}.{joint}"] = Dimension.ANGLE
        for name, dimension in JOINT_QUANTITIES.items():
            known[f"joints.{joint}.{name}"] = dimension
    return known


def parse_expectation(given: object, joint_names: tuple[str, ...]) -> Expectation:
    """An `expect:` line read; raises ValueError saying what is allowed."""
    match = _LINE.fullmatch(given) if isinstance(given, str) else None
    if match is None:
        raise ValueError(
            "expected QUANTITY OPERATOR VALUE (operators < <= > >= == !=), "
            f"such as 'failures == 0' or 'golden.tracking_rmse < 0.01 rad'; got {describe_value(given)}"
        )
    path, operator, written = match[1], match[2], match[3]
    known = quantities(joint_names)
    if path not in known:
        raise ValueError(f"unknown quantity {path!r}{did_you_mean(path, known)} (allowed: {_allowed(joint_names)})")
    dimension = known[path]
    if dimension is None:
        if not _COUNT.fullmatch(written):
            raise ValueError(f"{path} is a count; expected a whole number such as 0, got {written!r}")
        value = float(written)
    else:
        value = parse_quantity(written, dimension)
        if operator in ("==", "!="):
            raise ValueError(f"{path} is a measured value and never exactly equal to another; use < <= > or >=")
    return Expectation(path, operator, value, f"{path} {operator} {written}")


def _allowed(joint_names: tuple[str, ...]) -> str:
    return (
        f"{', '.join(COUNTS)}, {TRACKING}, {TRACKING}.JOINT, joints.JOINT.{{{', '.join(JOINT_QUANTITIES)}}} "
        f"with JOINT one of {', '.join(joint_names)}"
    )
