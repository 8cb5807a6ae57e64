"""Development tool: opens a report of `understudy teach` in a headless Chromium, checks it and takes pictures.

    python tools/screenshot_report.py drawer/report.html OUT_FOLDER

Checks at 400 and 1400 pixels, light and dark, with scripts and network off: no errors, all images and the video
decoded, nothing wider than the window, nothing asked for. Exits with 1 if anything is wrong. Needs Chromium and
websockets (the extra 'viewer').
"""

from __future__ import annotations

import argparse
import base64
import json
import sys
import tempfile
from pathlib import Path

from screenshot_viewer import Page, browse
from websockets.sync.client import connect

WIDTHS = (400, 1400)
_TALLEST = 16_000  # pixels of a picture
_STATE = """(() => JSON.stringify({
  images: document.images.length,
  broken: [...document.images].filter(i => !(i.complete && i.naturalWidth)).map(i => i.alt),
  videos: [...document.querySelectorAll("video")].map(v => [v.videoWidth, v.duration, v.error && v.error.message]),
  wide: document.documentElement.scrollWidth, window: window.innerWidth,
  over: [...document.querySelectorAll("body *")].filter(e => e.getBoundingClientRect().right > window.innerWidth + 1
    && !e.closest(".scroll")).map(e => e.tagName + "." + e.className).slice(0, 5),
  height: document.documentElement.scrollHeight, scripts: document.scripts.length}))()"""


class Report(Page):
    """A page that also notes what the browser itself logs."""

    def _note(self, message: dict) -> None:
        super()._note(message)
        if message.get("method") == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
            self.errors.append(message["params"]["entry"]["text"])


def look(page: Report, address: str, width: int, dark: bool, out: Path) -> list[str]:
    """What is wrong with the report at this width; also a picture."""
    metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    page.call("Emulation.setDeviceMetricsOverride", **metrics)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    page.call("Emulation.setEmulatedMedia", features=[scheme])
    page.call("Page.navigate", url=address)
    page.wait(3.0)
    state = json.loads(page.call("Runtime.evaluate", expression=_STATE, returnByValue=True)["result"]["value"])
    clip = {"x": 0, "y": 0, "width": width, "height": min(state["height"], _TALLEST), "scale": 1}
    shot = page.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
    path = out / f"{width}{'_dark' if dark else ''}.png"
    path.write_bytes(base64.b64decode(shot["data"]))
    print(path, state)
    wrong = [f"broken image: {alt}" for alt in state["broken"]]
    wrong += [f"video: {v}" for v in state["videos"] if not v[0] or v[2]]
    wrong += [] if state["wide"] <= width else [f"{state['wide']} pixels wide at {width}: {state['over']}"]
    return wrong + [f"{n} scripts" for n in [state["scripts"]] if n]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    address, wrong = args.report.resolve().as_uri(), []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process, socket_address = browse(folder)
        try:
            with connect(socket_address, max_size=None) as socket:
                page = Report(socket)
                for domain in ("Network", "Runtime", "Page", "Log"):
                    page.call(f"{domain}.enable")
                for width in WIDTHS:
                    for dark in (False, True):
                        wrong += look(page, address, width, dark, args.out)
        finally:
            process.terminate()
            process.wait(timeout=20)
    wrong += [f"error: {e}" for e in page.errors]
    wrong += [f"asked for {u[:80]}" for u in page.requests if not u.startswith(("data:", address))]
    print("\n".join(wrong) or "nothing wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
