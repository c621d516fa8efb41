"""Whether other machines can reach an address, and the token that they then need."""

from __future__ import annotations

import ipaddress
from contextlib import suppress

from cucumbervision.errors import AccessError

TOKEN_VARIABLE = "CUCUMBERVISION_TOKEN"
_SHORTEST_TOKEN = 16


def check_access(address: str, token: str) -> None:
    """Check that other machines need a token, and that it is long enough.

    Raises
    ------
    AccessError
        If other machines can reach the address and there is no token, or it is short.

    Examples
    --------
    >>> check_access("127.0.0.1", "")
    >>> check_access("0.0.0.0", "")
    Traceback (most recent call last):
    ...
    cucumbervision.errors.AccessError: 0.0.0.0: other machines can reach this address, and there is
    no token; set CUCUMBERVISION_TOKEN, or bind to 127.0.0.1
    """
    remedy = f"set {TOKEN_VARIABLE}, or bind to 127.0.0.1"
    if not token and not is_loopback(address):
        fault = "other machines can reach this address, and there is no token"
        raise AccessError(fault, source=address or "''", remedy=remedy)
    if token and len(token) < _SHORTEST_TOKEN:
        fault = f"the token has {len(token)} characters"
        remedy = f"give {_SHORTEST_TOKEN} or more, such as of `openssl rand -hex 16`"
        raise AccessError(fault, source=TOKEN_VARIABLE, remedy=remedy)


def is_loopback(address: str) -> bool:
    """Return whether an address to bind to is reachable only from this machine.

    An empty address means all interfaces; names other than localhost are not resolved.

    Examples
    --------
    >>> [is_loopback(a) for a in ("127.0.0.1", "localhost", "::1", "0.0.0.0", "", "192.168.1.5")]
    [True, True, True, False, False, False]
    """
    name = address.strip().strip("[]").lower()
    if name == "localhost":
        return True
    with suppress(ValueError):
        return ipaddress.ip_address(name).is_loopback
    return False
