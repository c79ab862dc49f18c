"""The states of an injector.

    inert --start--> armed --open--> active --close--> armed, or spent (once, infinite)
    armed --open, no value yet--> waiting --open at the next frame--> active; any --stop--> spent
    any but spent --disarm--> inert; inert or spent --arm--> armed, or inert while its start has not come
"""

from enum import Enum
from typing import Final


class Phase(Enum):
    """State of an injector."""

    INERT = "inert"
    ARMED = "armed"
    WAITING = "waiting"
    ACTIVE = "active"
    SPENT = "spent"


INERT: Final = Phase.INERT
ARMED: Final = Phase.ARMED
WAITING: Final = Phase.WAITING
ACTIVE: Final = Phase.ACTIVE
SPENT: Final = Phase.SPENT
