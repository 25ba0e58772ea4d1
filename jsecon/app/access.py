"""Access rules of jsecon's servers: where they listen, and what a request must carry.

A page of another site can send requests to a server on loopback under a name that it has made to stand for 127.0.0.1
(DNS rebinding). So without a token, a request must name this machine in its Host header. Beyond loopback, where only
`jsecon serve` listens, it must carry the token.
"""

import ipaddress
import os
import socket
from urllib.parse import urlsplit

from jsecon.errors import InputError, describe_error


def _is_loopback(host: str) -> bool:
    """Returns whether a host is this machine and cannot be reached by others: localhost, 127.0.0.0/8 or ::1."""
    try:
        return ipaddress.ip_address(host.strip("[]").partition("%")[0]).is_loopback
    except ValueError:
        return host.rstrip(".").lower() == "localhost"


def is_allowed_host(header: str) -> bool:
    """Checks whether a Host header names this machine, by a name of loopback."""
    try:
        host = urlsplit(f"//{header}").hostname
    except ValueError:
        return False
    return host is not None and _is_loopback(host)


def token_for(host: str, token: str) -> str:
    """Finds the token that clients of an address must have, or raises InputError where others reach it without one.

    A `token` of "" is that of the environment; the result is "" if no token is needed.
    """
    token = token or os.environ.get("JSECON_TOKEN", "")
    if not token and not _is_loopback(host):
        problem = f"others can reach {host}, so there must be a token that clients must have"
        raise InputError("--host", problem, remedy="Set --token, or leave --host out to listen on 127.0.0.1 alone.")
    return token


def listen(host: str, port: int) -> socket.socket:
    """Opens a socket that listens, of IPv4 or IPv6, or raises InputError; port 0 takes a free one."""
    try:
        addresses = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
        family, _, _, _, address = min(addresses, key=lambda info: info[0] != socket.AF_INET)
        return socket.create_server((address[0], port, *address[2:]), family=family)
    except (OSError, OverflowError, ValueError) as error:
        reason = describe_error(error) if isinstance(error, OSError) else "it is not an address"
        remedy = "Take another --port, or 0 to have one chosen. --host must be an address of this machine."
        raise InputError("--port", f"cannot listen on {bracketed(host)}:{port} ({reason})", remedy=remedy) from error


def bracketed(host: str) -> str:
    """Writes a host as it stands in a URL: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host and not host.startswith("[") else host
