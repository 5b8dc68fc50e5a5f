"""Which requests reach the live view: those of its own page, and of programs on this machine."""

import urllib.error
import urllib.request

import pytest

from rewax.viz.live_guard import guarded, is_loopback, names_of, refusal


@pytest.mark.parametrize(
    ("host", "origin", "served_at", "reason"),
    [
        ("127.0.0.1:8080", "http://127.0.0.1:8080", "127.0.0.1", None),
        ("localhost:8080", "http://localhost:8080", "127.0.0.1", None),
        ("[::1]:8080", "http://[::1]:8080", "127.0.0.1", None),
        ("127.0.0.1:8080", None, "127.0.0.1", None),
        ("127.0.0.1:8080", "https://evil.example", "127.0.0.1", "pages of https://evil.example may not connect"),
        ("127.0.0.1:8080", "http://127.0.0.1:9999", "127.0.0.1", "pages of http://127.0.0.1:9999 may not connect"),
        ("127.0.0.1:8080", "null", "127.0.0.1", "pages of null may not connect"),
        ("127.0.0.1:8080", "http://localhost:8080", "127.0.0.1", "may not connect to 127.0.0.1:8080"),
        (
            "evil.example:8080",
            "http://evil.example:8080",
            "127.0.0.1",
            "evil.example:8080: open it as localhost, or by",
        ),
        ("lab.example:8080", "http://lab.example:8080", "127.0.0.1", "not served as lab.example:8080"),
        ("192.168.0.2:8080", "http://192.168.0.2:8080", "0.0.0.0", None),
        ("Lab:8080", "http://lab:8080", "0.0.0.0", None),
        ("lab.example:8080", "http://lab.example:8080", "0.0.0.0", None),
        ("alias.example:8080", "http://alias.example:8080", "alias.example", None),
        ("lab.example:8080", "https://evil.example", "0.0.0.0", "pages of https://evil.example may not connect"),
        (
            "evil.example:8080",
            "http://evil.example:8080",
            "0.0.0.0",
            "open it as lab or lab.example or localhost, or by",
        ),
    ],
)
def test_the_origin_must_be_the_host_and_the_host_this_machine(host, origin, served_at, reason, monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "Lab")
    monkeypatch.setattr("socket.getfqdn", lambda: "lab.example")
    headers = {"Host": host} if origin is None else {"Host": host, "Origin": origin}
    found = refusal(headers, names_of(served_at))
    assert found is None if reason is None else reason in found


def test_loopback_addresses():
    assert all(map(is_loopback, ("127.0.0.1", "127.8.0.1", "::1", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "192.168.0.2", "lab.example")))


def test_a_block_that_starts_no_server_is_refused():
    pytest.importorskip("websockets")
    with pytest.raises(ValueError, match="cannot be kept from other sites"), guarded("127.0.0.1"):
        pass


def test_the_socket_of_the_live_view_is_closed_to_other_sites():
    pytest.importorskip("viser")
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    from rewax.viz.live import LiveViewer

    viewer = LiveViewer(port=0)
    try:
        address = viewer.url.replace("http", "ws", 1)
        for origin in ("https://evil.example", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                connect(address, origin=origin)
        with connect(address, origin=viewer.url, max_size=None) as own:
            assert own.response.status_code == 101
        wrong = urllib.request.Request(viewer.url, headers={"Host": "evil.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(wrong, timeout=10)
    finally:
        viewer.close()
