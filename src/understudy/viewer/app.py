"""`view`: a web page, served from this computer, that shows the results of `understudy estimate`."""

from __future__ import annotations

import contextlib
import io
import ipaddress
import logging
import os
import socket
import threading
import time
import webbrowser
from pathlib import Path
from types import TracebackType
from typing import Any

from understudy.errors import MissingExtraError, UnderstudyError
from understudy.viewer.panel import Panel
from understudy.viewer.results import Cache, Moment, Results
from understudy.viewer.scene import Scene

DEFAULT_FPS = 10.0
AHEAD = 3
"""frames loaded ahead while playing"""


def view(
    results: str | os.PathLike[str],
    recording: str | os.PathLike[str] | None = None,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    open_browser: bool = False,
    block: bool = True,
) -> Viewer:
    """Shows a folder that `understudy estimate` wrote as a web page; says where.

    `recording` is where the recording is now, if it is not where the results say. If `port` is taken the next free one
    is used; 0 takes any. With `block` this returns when interrupted (Ctrl-C), else at once, and the page lives until
    `close()`.
    """
    server_class = _server_class()
    opened = Results.open(Path(results), None if recording is None else Path(recording))
    try:
        free = free_port(host, port)
        viewer = Viewer(opened, _start(server_class, host, free), host)
    except BaseException:
        opened.recording.close()
        raise
    _announce(viewer, host, port, block)
    if open_browser:
        webbrowser.open(viewer.url)
    if block:
        viewer.wait()
    return viewer


def _announce(viewer: Viewer, host: str, port: int, block: bool) -> None:
    """Prints where the page is, and what is to be known about that."""
    if port not in (0, viewer.port):
        print(f"Port {port} is taken; using {viewer.port}.")
    if not is_local(host):
        print(
            f"WARNING: the viewer listens on {host!r}: whoever can reach this computer over the network can see "
            "the recording. There is no password and no encryption. Leave --host out to keep it to this computer."
        )
    print(f"Viewer: {viewer.url} (Ctrl-C ends it)" if block else f"Viewer: {viewer.url}", flush=True)


class Viewer:
    """A running viewer. Frames are drawn by one thread, the latest wish first; also a context manager."""

    def __init__(self, results: Results, server: Any, host: str):
        self.server: Any = server
        """the viser server"""
        self.results = results
        self.moment: Moment | None = None
        """what is shown"""
        self.position = -1
        """of what is shown, in people.json's frames"""
        self._host = host
        self._cache = Cache(results.load)
        self._fps = results.recording.fps or DEFAULT_FPS
        self._wanted, self._playing, self._closed = 0, False, False
        self._failure: Exception | None = None
        self._changed = threading.Condition()
        self.scene = Scene(server, results.camera, self._cache.get(self._first_with_people()))
        self.panel = Panel(
            server.gui,
            self,
            title=f"Understudy: {results.people.recording or results.recording.name}",
            frames=len(self),
            fps=min(max(self._fps, 1.0), 30.0),
            point_size_m=self.scene.point_size_m,
        )
        self._draw(0)
        self._thread = threading.Thread(target=self._run, name="understudy-viewer", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return len(self.results.people.frames)

    @property
    def port(self) -> int:
        return int(self.server.get_port())

    @property
    def url(self) -> str:
        host = {"0.0.0.0": "127.0.0.1", "": "127.0.0.1", "::": "[::1]"}.get(self._host, self._host)
        return f"http://{f'[{host}]' if ':' in host and '[' not in host else host}:{self.port}"

    # --- what the panel asks for; also for programs ---

    def go_to(self, position: int) -> None:
        """Shows a position soon. A newer wish replaces an older one."""
        with self._changed:
            self._wanted = min(max(position, 0), len(self) - 1)
            self._changed.notify_all()

    def step(self, by: int) -> None:
        self.go_to((self._wanted + by) % len(self))

    def toggle_playing(self) -> None:
        with self._changed:
            self._playing = not self._playing and len(self) > 1
            self._changed.notify_all()
        self.panel.playing(self._playing)

    def set_fps(self, fps: float) -> None:
        self._fps = fps

    def set_visible(self, group: str, shown: bool) -> None:
        self.scene.visible(group, shown)

    def set_point_size(self, metres: float) -> None:
        self.scene.set_point_size(metres)

    def set_see_through(self, on: bool) -> None:
        self.scene.see_through(on)

    # --- drawing ---

    def show(self, position: int) -> None:
        """`go_to` that returns when the frame is on its way to the browsers (or another was wished for)."""
        self.go_to(position)
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self.position == position or self._wanted != position)
            failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _draw(self, position: int) -> None:
        moment = self._cache.get(position)
        with self.server.atomic():
            self.scene.draw(moment)
            self.panel.show(moment, position)
            if self._wanted == position and self.panel.slider.value != position + 1:
                self.panel.slider.value = position + 1
        self.server.flush()
        with self._changed:
            self.position, self.moment = position, moment
            self._changed.notify_all()

    def _run(self) -> None:
        due = 0.0
        while True:
            with self._changed:
                while not self._closed and self._wanted == self.position:
                    wait = due - time.monotonic() if self._playing else None
                    if wait is not None and wait <= 0:
                        self._wanted = (self.position + 1) % len(self)
                        break
                    self._changed.wait(wait)
                if self._closed:
                    return
                target, playing = self._wanted, self._playing
            due = time.monotonic() + 1 / self._fps
            try:
                self._draw(target)
            except Exception as e:  # the page must live on, and whoever waits must hear of it
                logging.getLogger(__name__).exception("frame at position %d cannot be drawn", target)
                with self._changed:
                    self.position, self._failure = target, e
                    self._changed.notify_all()
            if playing:
                for ahead in range(1, AHEAD + 1):
                    self._cache.prefetch((target + ahead) % len(self))

    def _first_with_people(self) -> int:
        """Position of the first frame that has people with 3D joints; 0 if none has."""
        frames = self.results.people.frames
        return next((i for i, f in enumerate(frames) if Moment(f).lifted), 0)

    # --- life ---

    def wait(self) -> None:
        """Until Ctrl-C; then closes."""
        try:
            while not self._closed:
                time.sleep(0.5)
        except KeyboardInterrupt:
            print()
        finally:
            self.close()

    def close(self) -> None:
        """Ends the server and closes the recording. May be called twice."""
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout=10)
        self._cache.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
        self.results.recording.close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


# --- the server ---


def is_local(host: str) -> bool:
    """Whether only this computer can reach what listens on `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def free_port(host: str, port: int) -> int:
    """The first port from `port` on that can be listened on (0 = any). Raises UnderstudyError."""
    if not 0 <= port <= 65535:
        raise UnderstudyError(f"port must be in 0 ... 65535, got {port}")
    try:
        family = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0][0]
    except OSError as e:
        raise UnderstudyError(f"host {host!r} is not an address of this computer ({e}); try 127.0.0.1") from e
    problem: OSError | None = None
    for candidate in range(port, min(port + 100, 65536)) if port else (0,):
        with socket.socket(family, socket.SOCK_STREAM) as s:
            if os.name == "posix":
                s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                s.bind((host, candidate))
                return int(s.getsockname()[1])
            except OSError as e:
                problem = e
    raise UnderstudyError(f"no free port at {host!r} from {port} on ({problem})")


def _server_class() -> Any:
    """viser's server, unable to publish itself. Raises MissingExtraError without viser."""
    try:
        import viser
    except ImportError as e:
        raise MissingExtraError("The viewer", "viewer") from e

    class LocalServer(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """A page could ask for a public tunnel to this computer; never."""
            return None

    return LocalServer


def _start(server_class: Any, host: str, port: int) -> Any:
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner of its own
        return server_class(host=host, port=port, verbose=False)
