"""Who may use the live page: whoever sits at this machine, or has the token.

A page of another site, open in the same browser, must not move the track.  It cannot send the
cookie (SameSite) nor hide where it is from (Origin), and a name that it makes point at this
machine (DNS rebinding) is not a name that is served here (Host).  A command is taken only where
the browser states that it comes from this very page: to SameSite, another port is the same site.
"""

import re
import secrets
import socket
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import ip_address
from urllib.parse import urlsplit

from lscan.errors import InputError

TOKEN = re.compile(r"[A-Za-z0-9_-]{8,200}")
LOOPBACK = ("127.0.0.1", "localhost", "::1")
EVERYWHERE = {"0.0.0.0": (socket.AF_INET,), "::": (socket.AF_INET, socket.AF_INET6)}
"""The hosts that mean all addresses of this machine, with the families served then."""
ELSEWHERE = {socket.AF_INET: "192.0.2.1", socket.AF_INET6: "2001:db8::1"}
"""Addresses of nobody, kept for documentation (RFC 5737, RFC 3849): on no network of ours."""


@dataclass(frozen=True)
class Access:
    """Where the page is served, and to whom.  token: None where none is needed."""

    host: str
    port: int
    token: str | None

    @property
    def cookie(self) -> str:
        """Name of the cookie that holds the token; cookies are shared by all ports."""
        return f"lscan-{self.port}"

    @property
    def addresses(self) -> tuple[str, ...]:
        """What to type into a browser, the likeliest first.

        Where all of this machine is served, its numbers and last its name, which a telephone
        often cannot resolve.
        """
        names: tuple[str, ...] = (self.host,)
        if self.host in EVERYWHERE:
            names = (*machine_numbers(EVERYWHERE[self.host]), socket.gethostname())
        query = f"/?token={self.token}" if self.token else "/"
        return tuple(f"http://{_bracketed(name)}:{self.port}{query}" for name in names)

    @property
    def remark(self) -> str:
        """Who can move the track and switch the laser, in a line beneath the addresses."""
        if self.token is None:
            return (
                "every user of this machine can move the track and switch the laser; --token keeps "
                "others out"
            )
        seen = "" if self.host in LOOPBACK else "; plain HTTP shows the address to the network"
        return f"everybody with this address can move the track and switch the laser{seen}"

    def refusal(
        self, headers: Mapping[str, str], query_token: str | None = None, commands: bool = False
    ) -> str | None:
        """Why a request is refused, a plain sentence; None where it is not.

        headers: of the request, by their names in lower case.  query_token: from the address of
        the page itself, None everywhere else.  commands: whether it would change anything.
        """
        host, origin = headers.get("host", ""), headers.get("origin")
        if not self._serves(host):
            return f"This page is not served under the name {host[:80]!r}."
        if origin is not None and origin != f"http://{host}":
            return "Requests from pages of other sites are refused."
        if commands and origin is None and headers.get("sec-fetch-site") != "same-origin":
            return "Commands are taken from this page alone: the request names no Origin."
        if self.token is None:
            return None
        cookies = headers.get("cookie", "").split(";")
        pairs = (cookie.strip().partition("=") for cookie in cookies)
        # All cookies of our name: other programs of this host set theirs too.
        named = [value for name, _, value in pairs if name == self.cookie]
        given = named if query_token is None else [query_token]
        wanted = self.token.encode()
        if not any(secrets.compare_digest(token.encode(), wanted) for token in given):
            return "A token is needed: open the whole address that lscan live printed."
        return None

    def _serves(self, host: str) -> bool:
        try:
            parts = urlsplit(f"//{host}")
            name, port = parts.hostname or "", parts.port or 80
        except ValueError:
            return False
        if port != self.port or set(host) & set("/?#@"):
            return False
        if self.host in LOOPBACK:
            return name in LOOPBACK
        if self.host in EVERYWHERE:  # by number no site can be meant but this machine
            return _is_address(name) or name in (*LOOPBACK, socket.gethostname().lower())
        return name == self.host.lower()


def grant(host: str, port: int, token: str | None) -> Access:
    """Where the live page is served, and to whom.

    Parameters
    ----------
    host : str
        Name or number to serve under.
    port : int
        TCP port.
    token : str or None
        What a browser must present.  None: no token on this machine's own addresses, a random
        one on any other.

    Returns
    -------
    Access

    Raises
    ------
    InputError
        For a token too short to keep anybody out, or that no address can hold.

    Examples
    --------
    >>> grant("127.0.0.1", 8765, None).addresses
    ('http://127.0.0.1:8765/',)
    """
    if token is not None and not TOKEN.fullmatch(token):
        raise InputError(
            "not a token",
            where="--token",
            value=token,
            allowed="8 to 200 letters, digits, '-' and '_'",
        )
    if token is None and host not in LOOPBACK:
        token = secrets.token_urlsafe(16)
    return Access(host, port, token)


def machine_numbers(families: Iterable[socket.AddressFamily]) -> tuple[str, ...]:
    """The IP addresses of this machine that others may reach it by, each once.

    First those it goes out by, then those its own name has; no loopback and no link-local
    ones, which a browser elsewhere cannot use.  Empty where there are none.
    """
    found: dict[str, None] = {}
    for family in families:
        numbers: list[str] = []
        with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((ELSEWHERE[family], 9))  # sends nothing
            numbers.append(probe.getsockname()[0])
        with suppress(OSError):
            known = socket.getaddrinfo(socket.gethostname(), None, family, socket.SOCK_STREAM)
            numbers += [str(place[0]).partition("%")[0] for *_, place in known]
        for number in numbers:
            address = ip_address(number)
            if not (address.is_loopback or address.is_link_local or address.is_unspecified):
                found[number] = None
    return tuple(found)


def _bracketed(name: str) -> str:
    return f"[{name}]" if ":" in name else name


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
