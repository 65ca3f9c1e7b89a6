"""The page's door: the token, other sites, and whoever sends something else than a request."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.tools.web.browser.access import Access
from servoid.tools.web.browser.gate import LONGEST_HEAD, Gate


def test_this_machine_needs_no_token_and_elsewhere_does() -> None:
    assert Access.at("127.0.0.1").token is None
    assert Access.at("localhost").url(80) == "http://localhost:80/"
    one, other = Access.at("0.0.0.0"), Access.at("0.0.0.0")
    assert one.token
    assert one.token != other.token
    assert one.url(80) == f"http://0.0.0.0:80/{one.token}/"
    with pytest.raises(ConfigError, match="give the address of a network card"):
        Access.at("my robot")


def test_only_the_token_opens_the_page() -> None:
    access = Access("0.0.0.0", "secret")
    assert access.path("/secret/page.js", {}, 80) == "/page.js"
    assert access.path("/secret/", {}, 80) == "/"
    for target in ("/", "/secret", "/secre/", "/secret1/", "secret/", "/viser/", "//secret/", "/?token=secret"):
        with pytest.raises(PermissionError):
            access.path(target, {}, 80)


def test_another_site_in_the_same_browser_does_not_reach_the_page() -> None:
    """Any web page may open connections to 127.0.0.1; its name may even be made to mean 127.0.0.1."""
    access = Access("127.0.0.1", None)
    assert access.path("/", {"host": "localhost:8080"}, 8080) == "/"
    with pytest.raises(PermissionError):
        access.path("/", {"host": "evil.example:8080"}, 8080)
    own = {"host": "127.0.0.1:8080", "upgrade": "websocket"}
    assert access.path("/control", own | {"origin": "http://127.0.0.1:8080"}, 8080) == "/control"
    for origin in ({"origin": "http://evil.example"}, {"origin": "null"}, {}):
        with pytest.raises(PermissionError):
            access.path("/control", own | origin, 8080)


@pytest.mark.parametrize(
    ("sent", "answered"),
    [
        (b"GET / HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\n\r\n", b"page GET / "),
        (b"GET /viser/x HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\n\r\n", b"viser GET /x "),
        (b"GET /viserx HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\n\r\n", b"page GET /viserx "),
        (b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", b"HTTP/1.1 403"),
        (b"POST / HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\n\r\n", b"HTTP/1.1 400"),
        (b"\x00\xff\r\n\r\n", b"HTTP/1.1 400"),
        (b"GET / HTTP/1.1\r\n" + b"x" * (2 * LONGEST_HEAD), b""),
        (b"GET", b""),
    ],
)
def test_the_door_joins_what_may_pass_and_outlives_the_rest(sent: bytes, answered: bytes, tmp_path: Path) -> None:
    def behind(name: bytes):
        async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(name + b" " + await reader.readline())
            writer.close()

        return answer

    async def ask() -> bytes:
        viser = await asyncio.start_server(behind(b"viser"), "127.0.0.1", 0)
        page = await asyncio.start_unix_server(behind(b"page"), str(tmp_path / "page"))
        gate = Gate(Access("127.0.0.1", None), tmp_path / "page", viser.sockets[0].getsockname()[1])
        door = await gate.listen(0)
        reader, writer = await asyncio.open_connection("127.0.0.1", gate.port)
        writer.write(sent.replace(b"PORT", str(gate.port).encode()))
        if not sent.endswith(b"\r\n\r\n"):  # somebody who goes away in the middle of a request
            writer.write_eof()
        answer = await reader.read()
        writer.close()
        for server in (door, page, viser):
            server.close()
        return answer

    assert asyncio.run(ask()).startswith(answered)
