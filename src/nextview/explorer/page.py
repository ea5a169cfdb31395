"""The explorer's page: what is clicked and dragged goes to an ``Exploration``, and what follows is drawn."""

from __future__ import annotations

import errno
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from nextview.arguments import whole
from nextview.cameras.sensors import SENSORS
from nextview.errors import NextviewError, UsageError
from nextview.explorer.card import class_card, gallery, preview_card, walk_card
from nextview.explorer.exploration import Exploration, Walk
from nextview.explorer.walk_scene import WalkScene
from nextview.models.collection import find_models
from nextview.policies.policy_card import bundled_policies
from nextview.policies.registry import POLICIES, map_policy_names

NOTHING, CLEAN = "nothing", "clean renders"
GALLERY = 6
"""As many objects are shown as pictures; more as a list."""
APART = 8.5
"""Between two objects side by side, object radii."""
PAUSE = 0.5
"""Between the views of a policy that walks, seconds: long enough to see each."""
HELP = """Click a **ball** to look from there. Drag the **arrows** to look from anywhere else. Balls are coloured by
what the policy values them at: yellow most, violet least, grey what it does not consider. It would go to the large red
one next; small dark ones were visited."""


def _check_address(host: str, port: int) -> None:
    """See that something can be served at an address: viser would wait for ever, and take no host for all of them."""
    whole(port, "a port", 0, 65535)
    try:
        if not host:
            raise OSError("there is no name")
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as tried:
            tried.bind(address)
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) != errno.EADDRINUSE:
            raise UsageError(f"no page can be served at {host!r}, port {port} ({error})") from None


class Page:
    """A page in the browser on an exploration. All who open it see and drive the same.

    Args:
        exploration: what is shown.
        host: address that the page is served at; 0.0.0.0 for all of this machine.
        port: of the page; the next free one if it is taken.

    Raises:
        UsageError: nothing can be served there.
    """

    def __init__(self, exploration: Exploration, host: str = "127.0.0.1", port: int = 8080) -> None:
        _check_address(host, port)
        self.exploration = exploration
        self.server = viser.ViserServer(host, port, label="nextview explore", verbose=False)
        self._lock, self._quiet = threading.RLock(), False
        self._scenes: list[WalkScene] = []
        self._cards: list[viser.GuiHtmlHandle] = []
        self._panels: list[viser.PanelHandle] = []
        self._took: dict[int, float] = {}
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(209, 73, 91))
        gui.set_panel_label("nextview explore")
        self.server.scene.set_up_direction("+z")
        self._controls(gui)
        self._rebuild()

    @property
    def address(self) -> str:
        """Where the page is."""
        host = self.server.get_host()
        return f"http://{'localhost' if host in ('0.0.0.0', '127.0.0.1') else host}:{self.server.get_port()}"

    def stop(self) -> None:
        """Serve it no more."""
        self.server.stop()

    # What can be clicked

    def _controls(self, gui: viser.GuiApi) -> None:
        exploration = self.exploration
        by_map = map_policy_names(find_models(exploration.systems[0].loaded["models"]).maps)
        policies = list(dict.fromkeys([*exploration.policies, *bundled_policies(), *POLICIES, *by_map]))
        second = exploration.policies[1] if len(exploration.policies) > 1 else NOTHING
        gui.main_panel.dock_left()
        gui.add_markdown(HELP)
        self._object = gui.add_dropdown("Object", list(exploration.objects), initial_value=exploration.shown.name)
        if len(exploration.objects) <= GALLERY:
            self._object.visible = False
            gui.add_html(gallery(exploration.pictures()))
            names = gui.add_button_group("Object", list(exploration.objects))
            names.on_click(lambda event: setattr(self._object, "value", names.value))
        self._label = gui.add_html("")  # and no Markdown: viser would take a name for HTML
        self._policy = gui.add_dropdown("Policy", policies, initial_value=exploration.policies[0])
        self._second = gui.add_dropdown("Compare with", [NOTHING, *policies], initial_value=second)
        name, _, strength = (exploration.sensor or "").partition(":")
        self._sensor = gui.add_dropdown("Sensor", [CLEAN, *SENSORS, "mix"], initial_value=name or CLEAN)
        given = float(strength or 1)
        self._strength = gui.add_slider("Noise strength", 0.0, max(4.0, given), 0.25, initial_value=given)
        self._hide = gui.add_checkbox("Hide what was not seen", initial_value=exploration.mesh is None)
        step = gui.add_button("Next view by the policy")
        walk = gui.add_button("Walk until it stops")
        restart = gui.add_button("Start over")
        self._preview = gui.add_html("", visible=False)

        def on(handle: Any, act: Callable[[], None]) -> None:
            handle.on_update(lambda event: None if self._quiet else self._act(act, event.client))

        on(self._object, lambda: self._changed(partial(exploration.show, self._object.value)))
        on(self._policy, self._use_policies)
        on(self._second, self._use_policies)
        on(self._sensor, self._use_sensor)
        on(self._strength, self._use_sensor)
        on(self._hide, self._draw)
        step.on_click(lambda event: self._act(lambda: self._timed(exploration.step), event.client))
        walk.on_click(lambda event: self._walk(event.client))
        restart.on_click(lambda event: self._act(lambda: self._changed(exploration.restart), event.client))

    def _act(self, act: Callable[[], None], client: viser.ClientHandle | None) -> None:
        """Do what was asked for, one thing at a time; what is wrong with it is said, and the page stays as it was."""
        with self._lock:
            try:
                act()
            except NextviewError as error:
                with self._silence():
                    self._show_choices()
                for one in [client] if client is not None else self.server.get_clients().values():
                    one.add_notification("This cannot be done", str(error), color="red", auto_close_seconds=8)

    @contextmanager
    def _silence(self) -> Iterator[None]:
        """While the page itself changes what is chosen, nobody chooses."""
        self._quiet = True
        try:
            yield
        finally:
            self._quiet = False

    def _show_choices(self) -> None:
        """Let the page say what the exploration is at."""
        exploration = self.exploration
        name, _, strength = (exploration.sensor or CLEAN).partition(":")
        self._object.value, self._sensor.value = exploration.shown.name, name
        self._strength.value = float(strength or self._strength.value)
        self._policy.value, *second = exploration.policies
        self._second.value = second[0] if second else NOTHING

    def _use_policies(self) -> None:
        second = [] if self._second.value == NOTHING else [self._second.value]
        self._changed(lambda: self.exploration.compare([self._policy.value, *second]))

    def _use_sensor(self) -> None:
        named = None if self._sensor.value == CLEAN else f"{self._sensor.value}:{self._strength.value:g}"
        if named != self.exploration.sensor:
            self._changed(lambda: self.exploration.use_sensor(named))

    def _changed(self, change: Callable[[], None]) -> None:
        change()
        self._took.clear()
        self._rebuild()

    def _look(self, walk: int, where: int | NDArray[np.float64]) -> None:
        self._act(lambda: self._timed(lambda: self._walks[walk].look(where)), None)

    def _drag(self, walk: int, place: NDArray[np.float64], let_go: bool) -> None:
        """Show what would be seen while a camera is dragged, as often as there is time; look where it is let go."""
        pose = self.exploration.pose_towards(place)
        if let_go:
            self._preview.visible = False
            self._look(walk, pose)
        elif self._lock.acquire(blocking=False):
            try:
                self._preview.content = preview_card(self.exploration.preview(place))
                self._preview.visible = True
            finally:
                self._lock.release()

    def _walk(self, client: viser.ClientHandle | None) -> None:
        going = [True]

        def step() -> None:
            going[0] = False
            self._timed(lambda: going.__setitem__(0, self.exploration.walk_on()))

        while going[0]:
            self._act(step, client)
            time.sleep(PAUSE * going[0])

    # What is shown

    @property
    def _walks(self) -> Sequence[Walk]:
        return self.exploration.walks

    def _timed(self, take: Callable[[], Any]) -> None:
        """Take views, and tell how long it took from the click to the page."""
        before, begun = [len(walk.views) for walk in self._walks], time.perf_counter()
        take()
        milliseconds = 1000 * (time.perf_counter() - begun)
        taken = [k for k, walk in enumerate(self._walks) if len(walk.views) > before[k]]
        self._took = {k: milliseconds / len(taken) for k in taken}
        self._draw()

    def _rebuild(self) -> None:
        """Other objects, or another number of walks."""
        for shown in (*self._scenes, *self._panels):
            shown.remove()
        n = len(self._walks)
        self._scenes, self._cards, self._panels = [], [], []
        for k, walk in enumerate(self._walks):
            place = ((k - (n - 1) / 2) * APART, 0.0, 0.0)
            look, drag = partial(self._look, k), partial(self._drag, k)
            scene = WalkScene(self.server, f"/walk{k}", place, walk, self.exploration.mesh, look, drag)
            self._scenes.append(scene)
        for walk in self._walks:
            panel = self.server.gui.add_panel()
            with panel.add_tab(walk.system.policy_name):
                self._cards.append(self.server.gui.add_html(""))
            panel.dock_below(self._panels[-1]) if self._panels else panel.dock_right()
            panel.set_width(400)
            self._panels.append(panel)
        self._stand_back(n)
        label = self.exploration.shown.label
        self._label.content = "" if label is None else class_card(label)
        self._draw()

    def _stand_back(self, walks: int) -> None:
        """Let everyone see so many walks, if these are not as many as before."""
        position, at = np.array([0.0, -1.0, 0.55]) * (7.5 + 4.5 * (walks - 1)), np.array([0.0, 0.0, 0.4])
        first = self.server.initial_camera
        if np.allclose(first.position, position):
            return
        first.position, first.look_at = position, at
        for client in self.server.get_clients().values():
            client.camera.position, client.camera.look_at = position, at

    def _draw(self) -> None:
        with self.server.atomic():
            for k, (walk, scene, card) in enumerate(zip(self._walks, self._scenes, self._cards, strict=True)):
                scene.draw(walk, bool(self._hide.value))
                card.content = walk_card(walk, self._took.get(k))
