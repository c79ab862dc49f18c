"""Addresses of live control: `HOST:PORT`, or a path (with a `/` in it) for a Unix socket.

A Unix socket can be opened by the same user only.
"""

import contextlib
import socket
import stat
from pathlib import Path
from typing import Final

from fi_gateway.errors import FaultError

DEFAULT_ADDRESS: Final = "127.0.0.1:29537"


def is_path(address: str) -> bool:
    """Whether an address is that of a Unix socket."""
    return "/" in address


def split_address(address: str) -> tuple[str, int]:
    """`HOST:PORT` or `[IPv6]:PORT`; raises FaultError."""
    host, _, port = address.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) < 1 << 16):
        raise FaultError(
            f"live control: address {address!r} given, allowed HOST:PORT with port 0..65535 (0: a free one), such as "
            f"{DEFAULT_ADDRESS}, or a path with a / in it"
        )
    return host.removeprefix("[").removesuffix("]") or "127.0.0.1", int(port)


def connect(address: str, timeout_s: float) -> socket.socket:
    """A connection; raises OSError, and FaultError for an address that is none."""
    if not is_path(address):
        return socket.create_connection(split_address(address), timeout=timeout_s)
    link = unix_socket()
    link.settimeout(timeout_s)
    try:
        link.connect(address)
    except OSError:
        link.close()
        raise
    return link


def unix_socket() -> socket.socket:
    """A Unix socket; raises FaultError where there are none."""
    if not hasattr(socket, "AF_UNIX"):
        raise FaultError(f"live control: this system has no Unix sockets; use HOST:PORT, such as {DEFAULT_ADDRESS}")
    return socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)


def remove_left(path: Path) -> None:
    """Remove a socket that nobody listens at any more, as a killed process leaves it; anything else stays."""
    with contextlib.suppress(FileNotFoundError):
        if stat.S_ISSOCK(path.lstat().st_mode) and not _is_alive(path):
            path.unlink()


def _is_alive(path: Path) -> bool:
    """Whether somebody listens there."""
    try:
        connect(str(path), 1.0).close()
    except ConnectionRefusedError:
        return False
    except OSError:
        return True
    return True
