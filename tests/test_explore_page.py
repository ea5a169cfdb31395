"""The explorer's page, driven from Python."""

import http.client
import time
from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra 'explore' is not installed")
import msgspec
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from nextview.viewers.exploration import Exploration, shown_objects
from nextview.viewers.page import NO_ANSWER, Page

PATIENCE = 60_000
"""Milliseconds for what takes one on an idle machine."""


@pytest.fixture
def page():
    found = Page(Exploration(shown_objects(), start=3, threads=1), port=8790)
    yield found
    found.stop()


def until(happened, what):
    """Wait for what other threads do."""
    end = time.monotonic() + PATIENCE / 1000
    while not happened():
        assert time.monotonic() < end, what
        time.sleep(0.05)


def test_what_is_chosen_is_done_and_shown(page):
    exploration = page.exploration
    assert page.address == f"http://localhost:{page.server.get_port()}"
    page._look(0, 5)
    until(lambda: "view 5" in page._cards[0].content, "the card shows the view")
    page._second.value = "furthest"
    until(
        lambda: exploration.policies == ["gain", "furthest"] and len(page._cards) == 2,
        "two policies",
    )
    assert [walk.visited for walk in exploration.walks] == [[5], [5]]
    page._object.value = "monitor"
    until(lambda: exploration.shown.name == "monitor", "another object")
    page._second.value = NO_ANSWER
    until(
        lambda: exploration.policies == ["gain"] and len(page._scenes) == 1,
        "one policy",
    )
    page._sensor.value = "kinect"
    until(lambda: exploration.sensor == "kinect:1", "a sensor")
    page._strength.value = 2.0
    until(lambda: exploration.sensor == "kinect:2", "a stronger one")
    page._drag(0, np.array([1.0, -2.0, 1.0]), False)
    assert "<img" in page._preview.content
    assert not exploration.walks[0].views
    page._drag(0, np.array([1.0, -2.0, 1.0]), True)
    until(
        lambda: len(exploration.walks[0].views) == 1,
        "a view from where the camera was let go",
    )
    assert not page._preview.visible


def sockets(page, **headers):
    """A connection that sends what the page's own scripts send, with headers of the caller's
    choice.
    """
    address = f"ws://127.0.0.1:{page.server.get_port()}"
    return connect(
        address,
        additional_headers=headers,
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
    )


@pytest.mark.parametrize(
    ("host", "origin", "allowed"),
    [
        ("{address}", "http://{address}", True),
        ("{address}", None, True),
        ("localhost:{port}", "http://localhost:{port}", True),
        ("{address}", "http://evil.example", False),
        (
            "{address}",
            "http://127.0.0.1:1",
            False,
        ),  # another server of the same machine
        ("{address}", "null", False),
        # a name that points here (DNS rebinding)
        ("evil.example:{port}", "http://evil.example:{port}", False),
        ("", None, False),
        ("[::bad", None, False),  # no address at all
        ("[zz]:{port}", None, False),
        ("{address}", "http://[::bad", False),
    ],
)
def test_only_pages_of_its_own_may_drive_it(page, host, origin, allowed):
    port = page.server.get_port()
    names = {"address": f"127.0.0.1:{port}", "port": port}
    headers = {"Host": host.format(**names)} | (
        {} if origin is None else {"Origin": origin.format(**names)}
    )
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
    }
    upgrade |= {
        "Sec-WebSocket-Key": 22 * "A" + "==",
        "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
    }
    for more, answered in (({}, 200), (upgrade, 101)):
        with closing(http.client.HTTPConnection("127.0.0.1", port)) as connection:
            connection.request("GET", "/", headers=headers | more)
            with connection.getresponse() as response:
                assert response.status == (answered if allowed else 403)


CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
}
CAMERA |= {
    "image_height": 9,
    "image_width": 9,
    "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
    "position": [3, 0, 0],
}


def test_a_policy_that_is_not_listed_is_not_imported(page, tmp_path, monkeypatch):
    (tmp_path / "evilmod.py").write_text(
        f"open({str(tmp_path / 'imported')!r}, 'w')\ndef go(sphere): pass\n"
    )
    monkeypatch.chdir(tmp_path)
    said = []
    monkeypatch.setattr(
        viser.ClientHandle,
        "add_notification",
        lambda *about, **more: said.append(about[-1]),
    )
    with sockets(page) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))  # the first message of a page
        until(lambda: page.server.get_clients(), "viser knows the page")
        for sent in ("evilmod:go", NO_ANSWER, 3, None):
            message = {
                "type": "GuiUpdateMessage",
                "uuid": page._policy._impl.uuid,
                "updates": {"value": sent},
            }
            socket.send(msgspec.msgpack.encode(message))
            until(lambda: said, "the page says so")
            assert f"{sent}" in said.pop()
            until(
                lambda: page._policy.value == "gain",
                "the page goes back to what it was",
            )
    assert page.exploration.policies == ["gain"]
    assert not (tmp_path / "imported").exists()
    with pytest.raises(InvalidStatus):
        sockets(page, Origin="http://evil.example").__enter__()
