"""Who may use the live page: hosts, origins, tokens."""

import socket

import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.errors import InputError
from lscan.live.server import Access, grant

TOKEN = "correct-horse"


def refused(
    access, host, origin=None, cookie=None, query_token=None, fetch_site=None, commands=False
):
    """Why a request with these headers is refused, None where it is not."""
    named = {"host": host, "origin": origin, "cookie": cookie, "sec-fetch-site": fetch_site}
    headers = {name: value for name, value in named.items() if value is not None}
    return access.refusal(headers, query_token, commands)


@pytest.mark.parametrize("host", ["127.0.0.1:8765", "localhost:8765", "[::1]:8765"])
@pytest.mark.parametrize("served", ["127.0.0.1", "localhost", "::1"])
def test_this_machine_needs_no_token(served, host):
    access = grant(served, 8765, None)
    assert access.token is None
    assert refused(access, host) is None
    assert refused(access, host, origin=f"http://{host}") is None


@pytest.mark.parametrize(
    "host",
    [
        "",
        "evil.example",
        "evil.example:8765",
        "127.0.0.1",
        "127.0.0.1:80",
        "127.0.0.1:8766",
        "127.0.0.1:8765.evil.example",
        "localhost.evil.example:8765",
        "127.0.0.1:8765@evil.example",
        "user@127.0.0.1:8765",
        "127.0.0.1:8765/x",
        "[::1:8765",
        "127.0.0.1:x",
        "127.0.0.1:99999999",
    ],
)
def test_another_name_is_refused(host):
    """DNS rebinding: a name of somebody else's that was made to point here."""
    refusal = refused(grant("127.0.0.1", 8765, None), host)
    assert "not served under the name" in refusal


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "", "https://127.0.0.1:8765", "http://localhost:8765"],
)
def test_a_page_of_another_site_is_refused(origin):
    access = grant("127.0.0.1", 8765, None)
    assert "other sites" in refused(access, "127.0.0.1:8765", origin=origin)


def test_a_command_needs_this_very_origin():
    """Origin, which browsers send with every POST, or Sec-Fetch-Site where a proxy took it."""
    access, host = grant("127.0.0.1", 8765, None), "127.0.0.1:8765"
    for site in (None, "none", "same-site", "cross-site"):
        assert "Commands" in refused(access, host, fetch_site=site, commands=True)
        assert refused(access, host, fetch_site=site) is None
        assert refused(access, host, f"http://{host}", fetch_site=site, commands=True) is None
    assert refused(access, host, fetch_site="same-origin", commands=True) is None


def test_other_hosts_get_a_token_of_128_bits_each_another():
    tokens = {grant("0.0.0.0", 8765, None).token for _ in range(20)}
    assert len(tokens) == 20
    assert all(len(token) >= 128 / 6 for token in tokens)  # 6 bits a character


@pytest.mark.parametrize("served", ["127.0.0.1", "192.0.2.7", "scanner.example"])
def test_the_token_opens_by_address_or_cookie_alone(served):
    access = grant(served, 8765, TOKEN)
    host = f"{served}:8765"
    assert refused(access, host, query_token=TOKEN) is None
    assert refused(access, host, cookie=f"other=1; lscan-8765={TOKEN}") is None
    for cookie in ("", "lscan-8765=", "lscan-8765=wrong", f"lscan-1={TOKEN}", "\x00;;=", "é=é"):
        assert "token is needed" in refused(access, host, cookie=cookie)
    for wrong in ("", "wrong", TOKEN + "x", TOKEN.upper(), "ünïcode"):
        # A wrong token in the address is not made good by the cookie.
        assert refused(access, host, cookie=f"lscan-8765={TOKEN}", query_token=wrong)


@pytest.mark.parametrize(
    "other", ['x={"a":1}', "foo bar", "a b=1", "a[b]=1", 'theme="a,b', "x=é", "lscan-8765=evil", ""]
)
def test_cookies_of_other_programs_of_the_host_lock_nobody_out(other):
    access = grant("192.0.2.7", 8765, TOKEN)
    for cookies in (f"{other}; lscan-8765={TOKEN}", f"lscan-8765={TOKEN}; {other}"):
        assert refused(access, "192.0.2.7:8765", cookie=cookies) is None
    assert refused(access, "192.0.2.7:8765", cookie=other) is not None


@pytest.mark.parametrize("beside", ["#", "#/x", "/", "?", "?x"])
def test_a_host_is_a_name_and_a_port_alone(beside):
    access = grant("127.0.0.1", 8765, None)
    assert "not served" in refused(access, f"127.0.0.1:8765{beside}")
    assert "not served" in refused(access, "somebody@127.0.0.1:8765")


def test_the_address_holds_what_a_browser_needs():
    assert grant("127.0.0.1", 80, None).addresses == ("http://127.0.0.1:80/",)
    assert grant("::1", 8765, None).addresses == ("http://[::1]:8765/",)
    assert grant("192.0.2.7", 1, TOKEN).addresses == (f"http://192.0.2.7:1/?token={TOKEN}",)


class FakeProbe:
    """A UDP socket on a machine that goes out by 198.51.100.4, and by IPv6 not at all."""

    def __init__(self, family, kind):
        assert kind == socket.SOCK_DGRAM
        self.family = family

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def connect(self, _):
        if self.family == socket.AF_INET6:
            raise OSError("Network is unreachable")

    def getsockname(self):
        return "198.51.100.4", 40000


def named(*numbers):
    """A getaddrinfo by which this machine's name has these addresses."""

    def getaddrinfo(_, __, family, ___):
        kind = ":" if family == socket.AF_INET6 else "."
        return [(family, 1, 6, "", (number, 0)) for number in numbers if kind in number]

    return getaddrinfo


def test_it_is_said_who_can_move_the_track_and_who_can_read_the_token() -> None:
    assert "every user of this machine" in grant("127.0.0.1", 80, None).remark
    own, all_of_it = (grant(host, 80, "correct-horse").remark for host in ("::1", "0.0.0.0"))
    assert own == "everybody with this address can move the track and switch the laser"
    assert all_of_it == f"{own}; plain HTTP shows the address to the network"


def test_everywhere_has_an_address_for_each_number_and_the_name_last(monkeypatch):
    """Debian gives a machine's name 127.0.1.1; fe80:: needs an interface that no browser takes."""
    numbers = ("127.0.1.1", "198.51.100.4", "203.0.113.9", "::1", "fe80::1%eth0", "2001:db8::7")
    monkeypatch.setattr("lscan.live.server.socket.socket", FakeProbe)
    monkeypatch.setattr("lscan.live.server.socket.getaddrinfo", named(*numbers))
    monkeypatch.setattr("lscan.live.server.socket.gethostname", lambda: "scanner")
    expected = {
        "0.0.0.0": ["198.51.100.4", "203.0.113.9", "scanner"],
        "::": ["198.51.100.4", "203.0.113.9", "[2001:db8::7]", "scanner"],
    }
    for host, names in expected.items():
        access = grant(host, 8766, TOKEN)
        assert list(access.addresses) == [f"http://{name}:8766/?token={TOKEN}" for name in names]
        for name in names:
            assert refused(access, f"{name}:8766", query_token=TOKEN) is None


def test_a_machine_without_a_network_has_its_name_alone(monkeypatch):
    def unreachable(*_):
        raise OSError("Network is unreachable")

    monkeypatch.setattr("lscan.live.server.socket.socket", unreachable)
    monkeypatch.setattr("lscan.live.server.socket.getaddrinfo", unreachable)
    name = socket.gethostname()
    assert grant("::", 1, TOKEN).addresses == (f"http://{name}:1/?token={TOKEN}",)


def test_everywhere_is_served_by_number_or_by_this_machines_name():
    access = Access("0.0.0.0", 8765, TOKEN)
    for host in ("192.0.2.7:8765", "[2001:db8::1]:8765", f"{socket.gethostname()}:8765"):
        assert refused(access, host, query_token=TOKEN) is None
    assert refused(access, "evil.example:8765", query_token=TOKEN)


@pytest.mark.parametrize("token", ["", "short", "with space", "semi;colon", "é" * 9, "a" * 201])
def test_a_token_that_no_address_can_hold_is_refused(token):
    with pytest.raises(InputError, match="--token"):
        grant("127.0.0.1", 8765, token)


@examples(100)
@given(host=st.text(max_size=40), origin=st.none() | st.text(max_size=40), cookie=st.text())
def test_no_header_gets_past_a_token_unknown(host, origin, cookie):
    assert refused(grant("192.0.2.7", 8765, TOKEN), host, origin=origin, cookie=cookie)
