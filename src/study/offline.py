"""Nothing beyond this machine: with ``STUDY_OFFLINE`` set, every connection that Python code tries is refused by name.

Processes that this one starts inherit the variable, so notebooks are held to it, too; workers, which may have been
started before, are told with each call.
"""

from __future__ import annotations

import os
import socket
import sys
from functools import cache
from ipaddress import ip_address
from typing import Any

from study.errors import StudyError

VARIABLE = "STUDY_OFFLINE"
_CONNECTING = ("socket.connect", "socket.sendto", "socket.sendmsg")  # (socket, address)
_ASKING = ("socket.getaddrinfo", "socket.gethostbyname")  # (host, ...)


def is_offline() -> bool:
    """Whether nothing may be fetched: ``STUDY_OFFLINE`` is set, and not to 0."""
    return os.environ.get(VARIABLE, "").strip() not in ("", "0")


def go_offline() -> None:
    """Refuse connections from now on, here and in the processes that this one starts."""
    os.environ[VARIABLE] = "1"
    watch_connections()


def follow(offline: bool) -> None:
    """Be offline, or not, as the process that asks for work is."""
    if offline:
        go_offline()
    else:
        os.environ.pop(VARIABLE, None)


@cache
def watch_connections() -> None:
    """Ask `is_offline` at every connection of this process; Python has no way to take such a hook back."""
    sys.addaudithook(_refuse)


def _refuse(event: str, arguments: tuple[Any, ...]) -> None:
    if event in _CONNECTING:
        address = arguments[1]
        host = address[0] if isinstance(address, tuple) and address else None  # a path: of this machine
    elif event in _ASKING:
        host = arguments[0]
    else:
        return
    if host is None or not is_offline():
        return
    name = host.decode("ascii", "replace") if isinstance(host, bytes) else str(host)
    if not _is_here(name):
        raise StudyError(
            f"expected no connection beyond this machine (--offline, {VARIABLE}), got one to {name}; run without it"
        )


def _is_here(host: str) -> bool:
    if host in ("", "localhost", socket.gethostname()):
        return True
    try:
        return ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False
