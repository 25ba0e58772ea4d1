"""Who may reach the server and the viewer: names of this machine, tokens, content types, IPv4 and IPv6."""

import http.client
import socket

import pytest

from jsecon.app.access import is_allowed_host, listen, token_for
from jsecon.errors import InputError


@pytest.mark.parametrize(("header", "fits"), [
    ("127.0.0.1:8765", True), ("localhost", True), ("LOCALHOST.:80", True), ("[::1]:8765", True),
    ("127.9.9.9", True), ("box.lan:1", True), ("[fe80::2]:5", True), ("evil.example:8765", False),
    ("localhost.evil.example", False), ("127.0.0.1.evil.example", False), ("evil.example@", False), ("", False),
    ("[::1", False), ("0.0.0.0", False),
])  # fmt: skip
def test_only_names_of_this_machine_are_taken(header, fits):
    assert is_allowed_host(header, ("box.lan", "fe80::2")) == fits


def test_beyond_loopback_a_token_is_needed(monkeypatch):
    monkeypatch.delenv("JSECON_TOKEN", raising=False)
    for host in ("::1", "[::1]", "localhost"):
        assert token_for(host, "") == ""
    for host in ("0.0.0.0", "::", "192.168.0.3", "box"):
        with pytest.raises(InputError, match="--token"):
            token_for(host, "")
    assert token_for("0.0.0.0", "a") == "a"
    monkeypatch.setenv("JSECON_TOKEN", "b")
    assert token_for("0.0.0.0", "") == "b"


def test_addresses_of_both_families_are_listened_on():
    with listen("127.0.0.1", 0) as four:
        assert four.family == socket.AF_INET
        with pytest.raises(InputError, match="in use"):
            listen("127.0.0.1", four.getsockname()[1])
    for host in ("no.such.host.invalid", "a\0b", "x" * 300):
        with pytest.raises(InputError, match="cannot listen"):
            listen(host, 0)
    with pytest.raises(InputError, match="cannot listen"):
        listen("127.0.0.1", 70000)


@pytest.fixture(scope="module")
def pages():
    """(host, port, token) of viser servers: on loopback, on IPv6, and with a token."""
    viser = pytest.importorskip("viser", reason="the extra viewer is not installed")
    from jsecon.app.access import guarded_pages

    servers = []
    for host, token in (("127.0.0.1", ""), ("::1", ""), ("127.0.0.1", "s&cret ü")):
        try:
            with listen(host, 0) as found:
                port = found.getsockname()[1]
        except InputError:
            continue  # a machine without IPv6
        with guarded_pages(token, (host, "proxy.example")):
            servers.append((viser.ViserServer(host, port, verbose=False), host, token))
    yield [(host, server.get_port(), token) for server, host, token in servers]
    for server, _, _ in servers:
        server.stop()


def asked(host, port, path="/", **headers):
    """(status, headers) of a page; a header's name has _ for -."""
    connection = http.client.HTTPConnection(host, port, timeout=20)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status, answer.headers


SOCKET = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Protocol": "viser-v1.0.0",
}


def test_the_page_is_shown_to_who_names_this_machine(pages):
    for host, port, token in pages:
        if token:
            continue
        assert asked(host, port)[0] == 200
        assert asked(host, port, Host="proxy.example")[0] == 200
        assert asked(host, port, Host="evil.example")[0] == 403
        own = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        assert asked(host, port, Origin=f"http://{own}")[0] == 200
        for origin in ("https://evil.example", "null", "http://localhost:1"):
            assert asked(host, port, **SOCKET, Origin=origin)[0] == 403, origin


def test_the_page_with_a_token_is_shown_to_who_has_it(pages):
    host, port, _ = pages[-1]
    for path in ("/", "/?token=", "/?token=wrong", "/assets/x.js"):
        assert asked(host, port, path)[0] == 401
    assert asked(host, port, **SOCKET)[0] == 401
    status, headers = asked(host, port, "/?token=s%26cret+%C3%BC", Host="any.name")
    assert (status, headers["Location"]) == (302, "/")
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    kept = cookie.partition(";")[0]
    assert asked(host, port, Cookie=kept, Host="any.name")[0] == 200
    assert asked(host, port, Cookie=kept[:-1] + "x")[0] == 401
