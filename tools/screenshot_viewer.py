"""Development tool: starts the viewer on a folder of results, takes pictures of the page, lists what it asked for.

    python tools/screenshot_viewer.py RESULTS OUT.png [--recording PATH] [--position N ...] [--size 1400x900]
    python tools/screenshot_viewer.py RESULTS OUT.png --press Next Play Cloud

Needs the extra 'viewer' and Chromium (Debian: apt-get install chromium); draws WebGL in software, no display needed.
With several positions the pictures are OUT_0.png, OUT_1.png, ... `--press` presses those buttons (or check boxes) of
the page, waits two seconds after each, and takes one picture at the end.
Exits with 1 if the page asked any host but this computer for anything, or reported an error.
"""

from __future__ import annotations

import argparse
import base64
import itertools
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from urllib.parse import urlparse

from websockets.sync.client import ClientConnection, connect

from understudy.viewer import view

CHROMIUM = [
    "chromium",
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
]


class Page:
    """One page of a headless Chromium, over the DevTools protocol."""

    def __init__(self, socket: ClientConnection):
        self._socket = socket
        self._ids = itertools.count(1)
        self.requests: list[str] = []
        self.errors: list[str] = []

    def call(self, method: str, **params: object) -> dict:
        """Sends a command and waits for its answer."""
        id = next(self._ids)
        self._socket.send(json.dumps({"id": id, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("id") == id:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self._note(message)

    def wait(self, seconds: float) -> None:
        """Takes events for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                self._note(json.loads(self._socket.recv(timeout=left)))
            except TimeoutError:
                return

    def press(self, word: str) -> None:
        """Clicks the button with a word on it, or the check box in the row of that word."""
        script = f"""(() => {{
            const own = e => e.textContent.trim() === {json.dumps(word)};
            const button = [...document.querySelectorAll("button, [role=button]")].find(own);
            if (button) return button.click(), true;
            let row = [...document.querySelectorAll("label, div, p")].filter(own).pop();
            while (row && !row.querySelector("input[type=checkbox]")) row = row.parentElement;
            if (row) row.querySelector("input[type=checkbox]").click();
            return Boolean(row);
        }})()"""
        if not self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value"):
            raise RuntimeError(f"the page has nothing to press with the word {word!r}")

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
        print(path)

    def _note(self, message: dict) -> None:
        method, params = message.get("method"), message.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif method == "Network.webSocketCreated":
            self.requests.append(params["url"])
        elif method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description", details.get("text", "")))
        elif method == "Runtime.consoleAPICalled" and params["type"] == "error":
            self.errors.append(" ".join(str(a.get("value", a.get("description"))) for a in params["args"]))


def browse(folder: str) -> tuple[subprocess.Popen, str]:
    """A headless Chromium and the address of its first page's DevTools socket."""
    process = subprocess.Popen([*CHROMIUM, f"--user-data-dir={folder}", "about:blank"], stderr=subprocess.DEVNULL)
    port_file = Path(folder) / "DevToolsActivePort"
    for _ in range(300):
        if port_file.exists() and len(port_file.read_text().split()) == 2:
            break
        time.sleep(0.1)
    port, path = port_file.read_text().split()
    with connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as browser:
        target = Page(browser).call("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in target if t["type"] == "page")
    return process, f"ws://127.0.0.1:{port}/devtools/page/{page}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--position", type=int, nargs="+", default=[0])
    parser.add_argument("--size", default="1400x900")
    parser.add_argument("--wait", type=float, default=8.0, help="seconds for the page to draw")
    parser.add_argument("--press", nargs="+", default=[], help="words on buttons or check boxes of the page")
    args = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        view(args.results, args.recording, port=0, block=False) as viewer,
    ):
        process, address = browse(folder)
        try:
            with connect(address, max_size=None) as socket:
                page = Page(socket)
                for domain in ("Network", "Runtime", "Page"):
                    page.call(f"{domain}.enable")
                width, height = (int(n) for n in args.size.split("x"))
                metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
                page.call("Emulation.setDeviceMetricsOverride", **metrics)
                page.call("Page.navigate", url=viewer.url)
                page.wait(args.wait)
                if args.press:
                    for word in args.press:
                        page.press(word)
                        page.wait(2.0)
                        print(f"pressed {word}: position {viewer.position} is shown")
                    page.picture(args.out)
                else:
                    for position in args.position:
                        viewer.show(position)
                        page.wait(3.0)
                        several = len(args.position) > 1
                        page.picture(args.out.with_stem(f"{args.out.stem}_{position}") if several else args.out)
        finally:
            process.terminate()
            process.wait(timeout=20)
    return report(page, viewer.port)


def report(page: Page, port: int) -> int:
    """Prints what the page asked for; 1 if it was anything but the viewer's own server."""
    outside = [u for u in page.requests if urlparse(u).scheme not in ("data", "blob") and urlparse(u).port != port]
    print(f"requests: {len(page.requests)}, to elsewhere: {outside or 'none'}; errors: {page.errors or 'none'}")
    return 1 if outside or page.errors else 0


if __name__ == "__main__":
    sys.exit(main())
