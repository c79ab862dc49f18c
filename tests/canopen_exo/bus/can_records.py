"""Frames of all kinds, for their records in the kernel's form."""

import sys

import pytest
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame

linux = pytest.mark.skipif(sys.platform != "linux", reason="SocketCAN is Linux's")

IDS = st.one_of(
    st.tuples(st.integers(0, 0x7FF), st.just(0)), st.tuples(st.integers(0, 0x1FFFFFFF), st.just(FLAG_EXTENDED))
)


@st.composite
def frames(draw: st.DrawFn, raw_dlc: bool = True) -> Frame:
    can_id, flags = draw(IDS)
    kind = draw(st.sampled_from(("data", "remote", "fd")))
    if kind == "remote":
        return Frame(can_id, b"", flags | FLAG_REMOTE, draw(st.integers(0, 15 if raw_dlc else 8)))
    if kind == "fd":
        size = draw(st.sampled_from((*range(9), 12, 16, 20, 24, 32, 48, 64)))
        flags |= FLAG_FD | draw(st.sampled_from((0, FLAG_BRS, FLAG_ESI, FLAG_BRS | FLAG_ESI)))
        return Frame(can_id, draw(st.binary(min_size=size, max_size=size)), flags)
    data = draw(st.binary(max_size=8))
    dlc = draw(st.integers(8, 15)) if raw_dlc and len(data) == 8 else -1
    return Frame(can_id, data, flags, dlc)
