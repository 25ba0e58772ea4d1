"""Who may reach a server of jsecon: where it listens, and what a request must carry.

A page of another site can send requests to a server on loopback, under a name that it has made to stand for 127.0.0.1
(DNS rebinding). So without a token a request must name this machine in its Host header; beyond loopback it must carry
the token.
"""

import hmac
import ipaddress
import os
import socket
from collections.abc import Collection
from urllib.parse import urlsplit

from jsecon.errors import InputError, why

TOKEN = "JSECON_TOKEN"
"""environment variable with the token, where --token is not given"""


def loopback(host: str) -> bool:
    """Whether a host is this machine and no other can reach it: localhost, 127.0.0.0/8 or ::1."""
    try:
        return ipaddress.ip_address(host.strip("[]").partition("%")[0]).is_loopback
    except ValueError:
        return host.rstrip(".").lower() == "localhost"


def host_of(header: str) -> str:
    """The host of a Host header or an Origin, in lower case without port and brackets; "" for what names none."""
    try:
        name = urlsplit(header if "://" in header else f"//{header}").hostname
    except ValueError:
        return ""
    return (name or "").rstrip(".")


def named(header: str, hosts: Collection[str]) -> bool:
    """Whether a Host header names this machine: by a loopback name, or by one of `hosts`."""
    host = host_of(header)
    return bool(host) and (loopback(host) or host in {host_of(bracketed(name)) for name in hosts})


def right_token(given: str | bytes, token: str) -> bool:
    """Whether a token is the right one, in a time that tells nothing about it."""
    given = given.encode("utf-8", "surrogateescape") if isinstance(given, str) else given
    return hmac.compare_digest(given, token.encode("utf-8", "surrogateescape"))


def token_for(host: str, token: str) -> str:
    """The token that clients must have: as given, else of the environment. Raises InputError where others can reach
    the host and there is none."""
    token = token or os.environ.get(TOKEN, "")
    if not token and not loopback(host):
        found = f"others can reach {host}, so there must be a token that clients must have"
        raise InputError("--host", found, remedy="Set --token, or leave --host out to listen on 127.0.0.1 alone.")
    return token


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens, of IPv4 or IPv6. Raises InputError where the address cannot be had."""
    try:
        found = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
        family, _, _, _, place = min(found, key=lambda info: info[0] != socket.AF_INET)
        return socket.create_server((place[0], port, *place[2:]), family=family)
    except (OSError, OverflowError, ValueError) as error:
        reason = why(error) if isinstance(error, OSError) else "it is not an address"
        remedy = "Take another --port, or 0 to have one chosen. --host must be an address of this machine."
        raise InputError("--port", f"cannot listen on {bracketed(host)}:{port} ({reason})", remedy=remedy) from error


def bracketed(host: str) -> str:
    """A host as it stands in an address: IPv6 in brackets."""
    return f"[{host}]" if ":" in host and not host.startswith("[") else host
