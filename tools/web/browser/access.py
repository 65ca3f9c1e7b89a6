"""Who may see the page: on this machine anyone at it, from elsewhere whoever knows the token.

A token is the first part of every address of the page, so that there is none without it, and is in every request as
well. On this machine, where there is no token, another site that is open in the same browser must not reach the page:
requests bear the page's own host, and connections that stay open its origin.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from dataclasses import dataclass

from servoid.hw.config import ConfigError


@dataclass(frozen=True)
class Access:
    """Where the page is, and what it takes to reach it. `token` is None on this machine alone."""

    host: str
    token: str | None

    @classmethod
    def at(cls, host: str) -> Access:
        """A new token, unless only this machine reaches the host."""
        return cls(host, None if is_local(host) else secrets.token_urlsafe(16))

    @property
    def prefix(self) -> str:
        """What addresses begin with."""
        return "/" if self.token is None else f"/{self.token}/"

    def url(self, port: int) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{port}{self.prefix}"

    def path(self, target: str, headers: dict[str, str], port: int) -> str:
        """What follows the prefix in a request's target. Raises PermissionError with the reason to refuse it."""
        path = target.partition("?")[0]
        if self.token is not None:
            given, slash, rest = path[1:].partition("/")
            if not (path.startswith("/") and slash and hmac.compare_digest(given.encode(), self.token.encode())):
                raise PermissionError("open the address that was printed, with its token")
            path = "/" + rest
        elif headers.get("host", "") not in {f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]")}:
            raise PermissionError("the page is at 127.0.0.1")
        if "upgrade" in headers and headers.get("origin", "").partition("//")[2] != headers.get("host"):
            raise PermissionError("of another site")
        return path


def is_local(host: str) -> bool:
    """Whether only this machine reaches a host. Raises ConfigError where it is no address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise ConfigError(
            f"--view-host '{host}': give the address of a network card, such as 192.168.1.5, or 0.0.0.0 for all"
        ) from None
