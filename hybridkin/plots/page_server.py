"""A viser server for a page of our own alone: no other page connects, no other message is heard.

Its page has a title of its own; `fitted_camera` places the eye, `dashes` makes broken lines.

viser checks neither who connects nor what it is sent: any page that is open in the browser may
connect to this machine, steer, store files, and have the view shared in the internet. All that
this module needs of viser beyond its interface is in `_Gate` and `_set_title`.
"""

from __future__ import annotations

import io
import ipaddress
import math
import socket
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from typing import Any
from urllib.parse import urlsplit

from hybridkin._core.texts import script_text
from hybridkin.plots._camera import Camera, fitted_camera
from hybridkin.plots._dashes import dashes

__all__ = ["Camera", "dashes", "fitted_camera", "page_server", "stop"]


_FARTHEST = 1e9  # of a coordinate; no page sends more
_REFUSED = 1008  # code of a closed connection: policy violation
_Message = Mapping[str, Any]


def page_server(host: str, port: int, title: str, **options: Any) -> Any:
    """Return a running viser server that listens to its own page only.

    Parameters
    ----------
    host : str
        Address to listen to.
    port : int
        Port; the next free one if it is taken, and any free one for 0.
    title : str
        Title of the page, in the tab of the browser.
    **options
        Of ``viser.ViserServer``.

    Raises
    ------
    ImportError
        Without viser.
    RuntimeError
        If this version of viser has no place for the checks.
    """
    import viser

    with redirect_stdout(io.StringIO()):  # it prints, also if not verbose
        server = viser.ViserServer(host, port, verbose=False, **options)
    try:
        _Gate(host).guard(server)
        _set_title(server, title)
    except AttributeError as error:
        stop(server)
        raise RuntimeError(
            f"viser {viser.__version__} cannot be kept to its own page ({error}); install another "
            'version: pip install "viser==1.1.1".'
        ) from error
    return server


def stop(server: Any) -> None:
    """Stop a server; its port is free afterwards."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def _set_title(server: Any, title: str) -> None:
    """Set the title of every page, also of a recorded one, whose file says "Viser"."""
    from viser._messages import RunJavascriptMessage

    script = f"document.title = {script_text(title)};"
    server.gui._websock_interface.queue_message(RunJavascriptMessage(source=script))


class _Gate:
    """The checks of a server: who connects, and what is sent."""

    def __init__(self, host: str) -> None:
        name = socket.gethostname().lower()
        self._names = {"localhost", host.lower(), name, f"{name}.local"}
        self._said: set[str] = set()

    def guard(self, server: Any) -> None:
        """Check all connections of a server; who connected before must do so again."""
        sockets = server._websock_server
        connections = sockets._live_connections
        close_all = sockets.disconnect_all_clients

        async def check(client: Any) -> None:
            connection = connections[client.client_id]
            if self.may_connect(connection.request.headers):
                connection.recv = self._heard(connection.recv)
                return
            # What arrived before the end of the connection would still be read.
            connection.recv = _deaf(connection.recv)
            self._warn("A page of another origin tried to connect, and was refused")
            await connection.close(_REFUSED, "another origin")

        sockets.on_client_connect(check)
        close_all()

    def may_connect(self, headers: Any) -> bool:
        """Return whether a browser connects for the page that this server gave it.

        The host must be named as no stranger can name it: a domain may be made to lead here.
        """
        hosts = headers.get_all("Host")
        origins = headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_here(hosts[0]):
            return False
        if not origins:  # no browser, but a program that this user runs
            return True
        try:
            return len(origins) == 1 and urlsplit(origins[0]).netloc == hosts[0]
        except ValueError:
            return False

    def _is_here(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name in self._names or name.endswith(".localhost"):
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True

    def _heard(self, receive: Callable[..., Any]) -> Callable[..., Any]:
        """Return the method of a connection that waits for a message, without what is ignored."""

        async def next_message(*arguments: Any, **options: Any) -> Any:
            while True:
                raw = await receive(*arguments, **options)
                if _is_ours(raw):
                    return raw
                self._warn("The page sent what it never sends")

        return next_message

    def _warn(self, what: str) -> None:
        if what not in self._said:
            self._said.add(what)
            warnings.warn(f"{what}; it is ignored, also from now on.", stacklevel=2)


def _deaf(receive: Callable[[], Any]) -> Callable[[], Any]:
    """Return the method of a connection that hears nothing until its end, which raises."""

    async def until_closed() -> None:
        while True:
            await receive()

    return until_closed


def _is_ours(raw: Any) -> bool:
    """Return whether a message is one of those that the page of a view sends."""
    from msgspec import msgpack
    from viser._messages import Message

    try:
        content = msgpack.decode(raw)
        if not _CHECKS[content["type"]](content):
            return False
        Message.deserialize(raw)  # has all that it must have, and nothing else
    except Exception:  # what others send raises what it likes
        return False
    return True


def _numbers(values: object, n: int) -> bool:
    """Return whether a value is n finite numbers."""
    return isinstance(values, Sequence) and len(values) == n and all(map(_number, values))


def _number(value: object) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value) and abs(value) < _FARTHEST


def _is_camera(message: _Message) -> bool:
    vectors = ("position", "look_at", "up_direction")
    return (
        _numbers(message["wxyz"], 4)
        and all(_numbers(message[name], 3) for name in vectors)
        and all(map(_number, (message["fov"], message["near"], message["far"])))
        and all(map(_number, (message["image_height"], message["image_width"])))
    )


def _is_pose(message: _Message) -> bool:
    return (
        isinstance(message["name"], str)
        and _numbers(message["wxyz"], 4)
        and _numbers(message["position"], 3)
    )


def _is_drag(message: _Message) -> bool:
    return isinstance(message["name"], str)


def _is_value(message: _Message) -> bool:
    """Return whether a slider, a button or a box gets a value, and no other property."""
    updates = message["updates"]
    return (
        isinstance(message["uuid"], str) and [*updates] == ["value"] and _number(updates["value"])
    )


def _is_click(message: _Message) -> bool:
    return (
        message["event_type"] == "click"
        and _numbers(message["ray_origin"], 3)
        and _numbers(message["ray_direction"], 3)
        and all(_numbers(point, 2) for point in message["screen_pos"])
        and len(message["screen_pos"]) > 0
    )


_CHECKS: dict[str, Callable[[_Message], bool]] = {
    "ViewerCameraMessage": _is_camera,
    "GuiUpdateMessage": _is_value,
    "TransformControlsUpdateMessage": _is_pose,
    "TransformControlsDragStartMessage": _is_drag,
    "TransformControlsDragEndMessage": _is_drag,
    "ScenePointerMessage": _is_click,
}
