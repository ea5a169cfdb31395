"""The web page of the explorer: passes clicks to an ``Exploration`` and draws its state."""

import errno
import gzip
import re
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from html import escape
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from nextview.checks import extras, whole
from nextview.errors import NextviewError, UsageError
from nextview.figures.style import GROUND, PAPER, rgb
from nextview.policies.policy_card import bundled_policies
from nextview.policies.registry import map_policy_names, policy_names
from nextview.recognition.model_card import find_models
from nextview.simulation.sensor import SENSORS
from nextview.types import Float
from nextview.viewers.card import class_card, preview_card, walk_card
from nextview.viewers.exploration import Exploration
from nextview.viewers.walk_scene import WalkScene

with extras():
    import viser
    from websockets.asyncio import server as websocket

SAND = "#e9dfd0"  # at the bottom of the background
NO_ANSWER = "nothing"
CLEAN = "clean renders"
APART = 8.5  # between two objects side by side, object radii
LAMP_PLACE = (-4.0, -5.0, 8.0)  # position of the lamp
# seconds between the views of a policy that runs on its own
PAUSE = 0.5
PAGE_TITLE = "nextview explore"
VISER_TITLE = "<title>Viser</title>"  # default title of viser's pages
HELP = """Click a **ball** to look from there, or drag the **arrows**. The large **red** ball is where the policy would
look next. Yellow views promise most, violet ones least; small dark ones are done."""
_starting = threading.Lock()


class Page:
    """A web page that shows an exploration, served at a host and a port.

    All visitors see and control the same exploration.
    """

    def __init__(
        self,
        exploration: Exploration,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        self.exploration = exploration
        self.server = serve(host, port)
        self.stop = self.server.stop
        self._lock = threading.RLock()
        self._quiet = False
        self._scenes: list[WalkScene] = []
        self._cards: list[viser.GuiHtmlHandle] = []
        self._panels: list[viser.PanelHandle] = []
        gui = self.server.gui
        scene = self.server.scene
        gui.configure_theme(
            show_logo=False,
            show_share_button=False,
            brand_color=(209, 73, 91),
        )
        gui.set_panel_label(PAGE_TITLE)
        scene.set_up_direction("+z")
        # slightly darker towards the ground
        sky = np.linspace(rgb(PAPER), rgb(SAND), 256)
        scene.set_background_image(sky.astype(np.uint8)[:, None])
        scene.configure_default_lights(False)
        scene.configure_environment_map(None)
        scene.add_light_hemisphere(
            "/sky",
            sky_color=rgb(PAPER),
            ground_color=rgb(GROUND),
            intensity=3.0,
        )
        scene.add_light_directional(
            "/lamp",
            color=rgb(GROUND),
            intensity=2.0,
            cast_shadow=True,
            position=LAMP_PLACE,
        )
        self._controls(gui)
        self._rebuild()

    @property
    def address(self) -> str:
        """URL of the page."""
        host = self.server.get_host()
        name = "localhost" if host in ("0.0.0.0", "127.0.0.1") else host
        return f"http://{name}:{self.server.get_port()}"

    # Controls

    def _controls(self, gui: viser.GuiApi) -> None:
        exploration = self.exploration
        by_map = map_policy_names(
            find_models(exploration.systems[0].loaded["models"]).maps
        )
        policies = list(
            dict.fromkeys(
                [*exploration.policies, *bundled_policies(), *policy_names(), *by_map]
            )
        )
        self._policies = [NO_ANSWER, *policies]
        self._sensors = [CLEAN, *SENSORS, "mix"]
        second = exploration.policies[1] if len(exploration.policies) > 1 else NO_ANSWER
        gui.main_panel.dock_left()
        gui.add_markdown(HELP)
        self._object = gui.add_dropdown(
            "Object",
            list(exploration.objects),
            initial_value=exploration.shown.name,
        )
        # not Markdown, in which viser would interpret a name as HTML
        self._label = gui.add_html("")
        self._policy = gui.add_dropdown(
            "Policy",
            policies,
            initial_value=exploration.policies[0],
        )
        self._second = gui.add_dropdown(
            "Compare with",
            self._policies,
            initial_value=second,
        )
        name, _, strength = (exploration.sensor or "").partition(":")
        self._sensor = gui.add_dropdown(
            "Sensor",
            self._sensors,
            initial_value=name or CLEAN,
        )
        given = float(strength or 1)
        self._strength = gui.add_slider(
            "Noise strength",
            0.0,
            max(4.0, given),
            0.25,
            initial_value=given,
        )
        self._hide = gui.add_checkbox(
            "Only what was seen",
            initial_value=exploration.mesh is None,
        )
        step = gui.add_button("Take the next view")
        walk = gui.add_button("Continue until confident")
        restart = gui.add_button("Start over")
        self._preview = gui.add_html("", visible=False)

        def on(handle: Any, act: Callable[[], None]) -> None:
            handle.on_update(
                lambda event: None if self._quiet else self._act(act, event.client)
            )

        on(self._object, self._show_object)
        on(self._policy, self._use_policies)
        on(self._second, self._use_policies)
        on(self._sensor, self._use_sensor)
        on(self._strength, self._use_sensor)
        on(self._hide, self._draw)
        step.on_click(
            lambda event: self._act(lambda: self._drawn(exploration.step), event.client)
        )
        walk.on_click(lambda event: self._walk(event.client))
        restart.on_click(
            lambda event: self._act(
                lambda: self._changed(exploration.restart), event.client
            )
        )

    def _act(self, act: Callable[[], Any], client: viser.ClientHandle | None) -> Any:
        """Run one action at a time.

        An error is shown, the page is unchanged, and None is returned.
        """
        with self._lock:
            try:
                return act()
            except NextviewError as error:
                with self._silence():
                    self._show_choices()
                for one in (
                    [client]
                    if client is not None
                    else self.server.get_clients().values()
                ):
                    one.add_notification(
                        "This cannot be done",
                        str(error),
                        color="red",
                        auto_close_seconds=8,
                    )
                return None

    @contextmanager
    def _silence(self) -> Iterator[None]:
        """Ignore changes of controls that the page itself makes."""
        self._quiet = True
        try:
            yield
        finally:
            self._quiet = False

    def _show_choices(self) -> None:
        exploration = self.exploration
        name, _, strength = (exploration.sensor or CLEAN).partition(":")
        self._object.value = exploration.shown.name
        self._sensor.value = name
        self._strength.value = float(strength or self._strength.value)
        self._policy.value, *second = exploration.policies
        self._second.value = second[0] if second else NO_ANSWER

    def _show_object(self) -> None:
        name = _listed(self._object.value, self.exploration.objects)
        self._changed(lambda: self.exploration.show(name))

    def _use_policies(self) -> None:
        first = _listed(self._policy.value, self._policies[1:])
        second = _listed(self._second.value, self._policies)
        self._changed(
            lambda: self.exploration.compare(
                [first] if second == NO_ANSWER else [first, second]
            )
        )

    def _use_sensor(self) -> None:
        sensor = _listed(self._sensor.value, self._sensors)
        named = None if sensor == CLEAN else f"{sensor}:{float(self._strength.value):g}"
        if named != self.exploration.sensor:
            self._changed(lambda: self.exploration.use_sensor(named))

    def _changed(self, change: Callable[[], None]) -> None:
        change()
        self._rebuild()

    def _drawn(self, take: Callable[[], Any]) -> bool:
        """Take views and draw them. Returns the result of taking them as a bool."""
        taken = bool(take())
        self._draw()
        return taken

    def _look(self, walk: int, where: int | Float) -> None:
        self._act(
            lambda: self._drawn(lambda: self.exploration.walks[walk].look(where)), None
        )

    def _drag(self, walk: int, place: Float, let_go: bool) -> None:
        """Show a preview while a camera is dragged, and take the view where it is released."""
        if let_go:
            self._preview.visible = False
            self._look(walk, self.exploration.pose_towards(place))
        elif self._lock.acquire(blocking=False):
            try:
                self._preview.content = preview_card(
                    self.exploration.preview(place),
                    self.exploration.walks[walk],
                )
                self._preview.visible = True
            finally:
                self._lock.release()

    def _walk(self, client: viser.ClientHandle | None) -> None:
        while self._act(lambda: self._drawn(self.exploration.walk_on), client):
            time.sleep(PAUSE)

    # Drawing

    def _rebuild(self) -> None:
        """Rebuild the page for other objects, or another number of walks."""
        for shown in (*self._scenes, *self._panels):
            shown.remove()

        n = len(self.exploration.walks)
        self._scenes = []
        self._cards = []
        self._panels = []
        for k, walk in enumerate(self.exploration.walks):
            place = ((k - (n - 1) / 2) * APART, 0.0, 0.0)
            look = partial(self._look, k)
            drag = partial(self._drag, k)
            self._scenes.append(
                WalkScene(
                    self.server,
                    f"/walk{k}",
                    place,
                    walk,
                    self.exploration.mesh,
                    look,
                    drag,
                )
            )

            panel = self.server.gui.add_panel()
            with panel.add_tab(walk.system.policy_name):
                self._cards.append(self.server.gui.add_html(""))
            panel.dock_below(self._panels[-1]) if self._panels else panel.dock_right()
            panel.set_width(400)
            self._panels.append(panel)

        position = np.array([0.38 * (n < 2), -0.92, 0.42]) * (6.6 + 6.0 * (n - 1))
        at = np.array([0.0, 0.0, 0.75])
        if not np.allclose(self.server.initial_camera.position, position):
            cameras = [
                self.server.initial_camera,
                *(client.camera for client in self.server.get_clients().values()),
            ]
            for camera in cameras:
                camera.position = position
                camera.look_at = at

        label = self.exploration.shown.label
        self._label.content = "" if label is None else class_card(label)
        self._draw()

    def _draw(self) -> None:
        with self.server.atomic():
            for walk, scene, card in zip(
                self.exploration.walks,
                self._scenes,
                self._cards,
                strict=True,
            ):
                scene.draw(walk, bool(self._hide.value))
                card.content = walk_card(walk)


def _listed(value: object, options: Collection[str]) -> str:
    """Return a choice from a list, checked.

    A client can send any value, including the name of a plugin, which is rejected.
    """
    if not isinstance(value, str) or value not in options:
        raise UsageError(f"{value!r} is none of the options here")
    return value


def serve(host: str, port: int) -> viser.ViserServer:
    """Start a server whose page can be controlled only by its own scripts.

    Args:
        host: address to listen on.
        port: to listen on; the next free one if it is taken.

    Returns:
        The server.
    """
    _check_address(host, port)
    plain = websocket.serve

    def guarded(
        handler: Any,
        *address: Any,
        process_request: Any,
        **options: Any,
    ) -> Any:
        def check(connection: Any, request: Any) -> Any:
            headers = request.headers
            reason = refused(headers.get_all("Host"), headers.get_all("Origin"), host)
            if reason:
                return connection.respond(403, f"{reason}\n")
            return _with_title(process_request(connection, request))

        return plain(handler, *address, process_request=check, **options)

    with _starting:  # viser has no option to check requests
        websocket.serve = guarded  # type: ignore[assignment, misc]
        try:
            server = viser.ViserServer(
                host,
                port,
                label=PAGE_TITLE,
                verbose=False,
            )
        finally:
            websocket.serve = plain  # type: ignore[misc]
    server.request_share_url = lambda verbose=True: (
        None
    )  # visitors must not open a tunnel
    return server


def titled(page: str, title: str) -> str:
    """Replace the title of a viser page, which is shown in the browser tab.

    Args:
        page: HTML.
        title: plain text.
    """
    return page.replace(VISER_TITLE, f"<title>{escape(title)}</title>", 1)


def _with_title(response: Any) -> Any:
    """Replace the title in a response if it contains the page."""
    if response is None or "text/html" not in response.headers.get("Content-Type", ""):
        return response
    zipped = response.headers.get("Content-Encoding") == "gzip"
    body = gzip.decompress(response.body) if zipped else response.body
    page = titled(body.decode(), PAGE_TITLE).encode()
    response.body = gzip.compress(page) if zipped else page
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
    return response


def refused(hosts: Sequence[str], origins: Sequence[str], served: str) -> str | None:
    """Decide from its headers whether to reject a request.

    A page of another site can reach this machine in two ways. If it uses this machine's address,
    the header Origin names the site. If it uses its own name that points to this address, the
    header Host has that name.

    Args:
        hosts: values of the header Host.
        origins: values of the header Origin.
        served: name or address under which the page is served.

    Returns:
        The reason; None if the request is accepted.
    """
    name = _host_name(hosts[0]) if len(hosts) == 1 else None
    if name is None:
        return "the header Host has to name one host"
    own = socket.gethostname().lower()
    is_number = ":" in name or re.fullmatch(r"[\d.]+", name)
    if not is_number and name not in ("localhost", served.lower(), own, f"{own}.local"):
        return f"no page is served under the name {name}"
    if any(_place(origin) != hosts[0].lower() for origin in origins):
        return "a page of another site may not drive this one"
    return None


def _host_name(host: str) -> str | None:
    """Return the name in a header Host, without its port; None if it is missing or invalid."""
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:  # an unclosed bracket, or an invalid address in brackets
        return None


def _place(origin: str) -> str | None:
    """Return host and port of a header Origin; None if it is invalid."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return None


def _check_address(host: str, port: int) -> None:
    """Check that the address can be used; viser would wait forever."""
    whole(port, "a port", 0, 65535)
    try:
        if not host:
            raise OSError("there is no name")
        family, kind, protocol, _, address = socket.getaddrinfo(
            host,
            port,
            type=socket.SOCK_STREAM,
        )[0]
        with socket.socket(family, kind, protocol) as tried:
            tried.bind(address)
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) != errno.EADDRINUSE:
            raise UsageError(
                f"no page can be served at {host!r}, port {port} ({error})"
            ) from None
