"""The page in the browser: a handle to drag, sliders, keys, and what the arm says."""

from __future__ import annotations

import contextlib
import io
import math
import socket
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from grr_torch.applications.teleoperation_log import Step
from grr_torch.errors import MissingPackageError, ParameterError
from grr_torch.interactive.handle import Handle
from grr_torch.interactive.scene import ArmView, MapView, TrailView
from grr_torch.interactive.session import Session
from grr_torch.recording import colours
from grr_torch.recording.self_motion_view import in_space

# the arm and the words on the page are renewed so often [s]
_ARM_PERIOD, _WORDS_PERIOD = 1.0 / 30.0, 0.1
# coordinates that have a slider, and the keys that move the target along them; the camera has the arrows and W A S D
# Q E. Directions and quaternions have neither, but the handle turns
_KEYS = {"x": ("L", "J"), "y": ("I", "K"), "z": ("U", "O"), "yaw": ("M", "N")}
# what a key turns by [rad]
_TURN = 0.05


class Page:
    """Shows a session, and moves its target. Whatever a browser does, only the target and the clutch change.

    Attributes:
        url: Where it is.
    """

    def __init__(self, session: Session, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Opens the page.

        Args:
            session: What is shown.
            host: The address it is bound to.
            port: The port; 0 for any that is free.

        Raises:
            MissingPackageError: viser is not installed.
            ParameterError: The address cannot be bound, or the port is in use.
        """
        self._server = _serve(host, port, session.roadmap.robot.name)
        self.url = f"http://{host}:{self._server.get_port()}"
        self._session = session
        robot = session.roadmap.robot
        self._arm, self._map = ArmView(self._server, robot), MapView(self._server, session.roadmap)
        self._trail = TrailView(self._server, self._place(session.tool))
        self._dot = self._server.scene.add_icosphere("/tool", radius=0.012 * self._size(), color=(255, 255, 255))
        task, size = session.roadmap.task, 0.16 * self._size()
        self._handle = Handle(self._server, task, size, session.target, self._dragged)
        self._words, self._sliders = self._add_panel()
        self._add_keys()
        self._shown = (-1.0, -1.0)
        self._times: list[float] = []
        self._arm.show(session.configuration)
        self._aim()

    def show(self, step: Step) -> None:
        """Shows a step, unless one was shown just before; it queues what is to be sent, and waits for no browser."""
        now = time.perf_counter()
        self._times.append(step.seconds)
        if now - self._shown[0] >= _ARM_PERIOD:
            self._shown = (now, self._shown[1])
            tool = self._place(self._session.tool)
            with self._server.atomic():
                self._arm.show(step.configuration)
                self._dot.position, self._dot.color = tool, colours.STATUS[step.status]
                self._trail.show(tool, step.status)
        if now - self._shown[1] >= _WORDS_PERIOD:
            self._shown = (self._shown[0], now)
            self._words.content = self._status(step, float(np.median(self._times)))
            self._times.clear()

    def close(self) -> None:
        """Closes the page."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _dragged(self, point: list[float]) -> None:
        self._session.move(point)
        self._show_target()

    def _add_panel(self) -> tuple[Any, list[Any]]:
        """Status, target, and what is shown; the words and the sliders."""
        gui, session = self._server.gui, self._session
        words = gui.add_html(self._status(None, 0.0))
        sliders = []
        units = "[m]" if session.roadmap.task.rotations is None else "[m, rad]"
        ends = [*zip(session.low.tolist(), session.high.tolist(), strict=True), (-math.pi, math.pi)]
        with gui.add_folder(f"Target {units}"):
            for axis, name in enumerate(self._moved()):
                low, high, value = (round(number, 3) for number in (*ends[axis], session.target[axis]))
                slider = gui.add_slider(name, low, high, 0.001, value)
                slider.on_update(self._slid(axis))
                sliders.append(slider)
            self._button("Home", "home", session.go_home, "Back to where the target was at the start")
            self._button("Stop: target to the tool", "hand-stop", session.reset, "The arm stops where it is")
            self._clutch = gui.add_checkbox(
                "Clutch", True, hint="The arm follows; let go, it holds, and the target may be moved to anywhere"
            )
            self._clutch.on_update(self._clutched)
        with gui.add_folder("Show"):
            for name, part in self._map.parts.items():
                gui.add_checkbox(name.capitalize(), bool(part.visible)).on_update(_shows(part))
        with gui.add_folder("Keys"):
            keys = [f"{name}: **{less}** − **{more}** +" for name, (more, less) in self._moved().items()]
            gui.add_markdown(f"{' · '.join(keys)}\n\n**R** stop · **H** home · **C** clutch")
        return words, sliders

    def _button(self, label: str, icon: str, action: Callable[[], None], hint: str) -> None:
        self._server.gui.add_button(label, icon=icon, hint=hint).on_click(self._does(action))

    def _slid(self, axis: int) -> Any:
        async def slid(event: Any) -> None:
            # a change that came from here is not one of the operator's
            if event.client is not None:
                target = list(self._session.target)
                target[axis] = event.target.value
                self._session.move(target)
                self._show_target()

        return slid

    async def _clutched(self, event: Any) -> None:
        if event.client is not None:
            self._set_clutch(event.target.value)

    def _set_clutch(self, engaged: bool) -> None:
        (self._session.engage if engaged else self._session.let_go)()
        self._clutch.value = engaged
        self._show_target()

    def _add_keys(self) -> None:
        """Hot keys, which are also in the page's list of commands."""
        step = 0.01 * self._size()
        moves: list[tuple[str, str, Callable[[], None]]] = []
        for axis, (name, keys) in enumerate(self._moved().items()):
            by, said = (_TURN, f"{math.degrees(_TURN):.0f}°") if name == "yaw" else (step, f"{1e3 * step:.0f} mm")
            for key, sign in zip(keys, (1.0, -1.0), strict=True):
                label = f"Target {'+' if sign > 0 else '−'}{name} by {said}"
                moves.append((label, key, partial(self._session.nudge, axis, sign * by)))
        moves += [
            ("Stop: target to the tool", "R", self._session.reset),
            ("Target home", "H", self._session.go_home),
            ("Clutch", "C", lambda: self._set_clutch(not self._session.engaged)),
        ]
        for label, key, action in moves:
            self._server.gui.add_command(label, hotkey=key).on_trigger(self._does(action))

    def _does(self, action: Callable[[], None]) -> Any:
        async def does(_: Any) -> None:
            action()
            self._show_target()

        return does

    def _show_target(self) -> None:
        """Puts handle and sliders where the target is. Called in the server's own loop only, so in order."""
        self._handle.show(self._session.target)
        for slider, value in zip(self._sliders, self._session.target, strict=False):
            slider.value = float(np.clip(round(value, 3), slider.min, slider.max))

    def _status(self, step: Step | None, median: float) -> str:
        """What is said of a step, as HTML."""
        status = "starting" if step is None else step.status
        hue = "rgb(128,128,128)" if step is None else "rgb({}, {}, {})".format(*colours.STATUS[step.status])
        figures = [("clearance", "–", "mm"), ("to target", "–", "mm"), ("step", "–", "ms")]
        if step is not None:
            away, turned = self._session.residuals(step)
            clearance = f"{1e3 * step.clearance:.0f}" if np.isfinite(step.clearance) else "–"
            figures = [
                ("clearance", clearance, "mm"),
                ("to target", f"{1e3 * away:.0f}", "mm"),
                ("step", f"{1e3 * median:.1f}", "ms"),
            ]
            if self._session.roadmap.task.rotations is not None:
                figures.insert(2, ("turned", f"{math.degrees(turned):.0f}", "°"))
        cells = "".join(
            f'<div style="flex:1"><div style="opacity:.6;font-size:.8em">{name}</div><span id="grr-{name.split()[-1]}"'
            f' style="font-size:1.35em;font-weight:600">{value}</span> {unit}</div>'
            for name, value, unit in figures
        )
        badge = "color:#fff;font-weight:700;text-align:center;border-radius:6px;padding:.25em;letter-spacing:.06em"
        return (
            f'<div style="padding:.5em .75em 0"><div id="grr-status" style="background:{hue};{badge}">{status}</div>'
            f'<div style="display:flex;padding:.5em .1em 0;font-variant-numeric:tabular-nums">{cells}</div></div>'
        )

    def _aim(self) -> None:
        """The camera looks at the roadmap: from the side and above, in the plane from above."""
        roadmap = self._session.roadmap
        points = in_space(roadmap.positions[roadmap.resolved].numpy())
        points = np.concatenate([points, np.zeros((1, 3))])
        centre, flat = 0.5 * (points.min(0) + points.max(0)), roadmap.task.dimension == 2
        home = self._place(self._session.target)
        azimuth = float(np.arctan2(home[1], home[0])) + 0.8
        side = np.array([0.0, -0.01, 1.0] if flat else [np.cos(azimuth), np.sin(azimuth), 0.5])
        camera = self._server.initial_camera
        camera.position = centre + 0.82 * self._size() * side / np.linalg.norm(side)
        camera.look_at = centre
        if not flat:
            floor = float(min(points[:, 2].min(), 0.0))
            self._server.scene.add_grid(
                "/floor",
                position=(0.0, 0.0, floor),
                cell_size=0.1,
                section_size=0.5,
                cell_color=(40, 43, 50),
                section_color=(62, 68, 80),
                infinite_grid=True,
                fade_distance=3.0 * self._size(),
            )

    def _size(self) -> float:
        """The roadmap's diagonal [m]."""
        points = self._session.roadmap.positions[self._session.roadmap.resolved]
        return max(float((points.amax(0) - points.amin(0)).norm()), 0.05)

    def _moved(self) -> dict[str, tuple[str, str]]:
        """The coordinates that can be moved one by one, which come first in a point, and their keys."""
        return {name: _KEYS[name] for name in self._session.roadmap.task.coordinates if name in _KEYS}

    def _place(self, point: tuple[float, ...]) -> np.ndarray:
        """(3,) a point of the task space."""
        place: np.ndarray = in_space(np.array(point[: self._session.roadmap.task.dimension])[None])[0]
        return place


def _serve(host: str, port: int, name: str) -> Any:
    try:
        import viser
    except ImportError as error:
        raise MissingPackageError("viser", "interactive", "the page in the browser") from error
    # viser would take another port, and never return where the host is wrong
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ParameterError(
            "host and port", f"{host}:{port}", f"an address that can be bound, 0 for any ({reason})"
        ) from error
    # it prints a table of its addresses
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label=f"grr-torch · {name}", verbose=False)
    if port not in (0, server.get_port()):
        server.stop()
        raise ParameterError("host and port", f"{host}:{port}", "an address that can be bound (the port is in use)")
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(70, 150, 255))
    return server


def _shows(part: Any) -> Any:
    async def shows(event: Any) -> None:
        part.visible = event.target.value

    return shows
