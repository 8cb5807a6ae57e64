"""The report: one file that needs nothing else, says what happened, and shows it."""

from __future__ import annotations

import base64
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import adaptation_scenes as scenes
import cv2
import numpy as np
import pytest

for package in ("pinocchio", "sklearn", "mujoco", "numba"):
    pytest.importorskip(package, reason=f"{package} is not installed (extra 'robot')")
pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra 'plots')")

import teaching_scenes  # noqa: E402

from understudy import report  # noqa: E402
from understudy.actions import Skill, learn  # noqa: E402
from understudy.adaptation.metrics import MORE, ROWS, evaluate  # noqa: E402
from understudy.demonstration import plots  # noqa: E402
from understudy.demonstration.demonstration import Demonstration  # noqa: E402
from understudy.execution.trials import wilson_interval  # noqa: E402
from understudy.people_file import FramePeople, PeopleFile  # noqa: E402
from understudy.recordings import write_recording  # noqa: E402
from understudy.report import pictures  # noqa: E402
from understudy.report.report import verdict  # noqa: E402
from understudy.report.sections import reproduced  # noqa: E402
from understudy.teaching import Teaching  # noqa: E402
from understudy.teaching_folder import Seen  # noqa: E402
from understudy.teaching_motions import robot_motions  # noqa: E402
from understudy.teaching_stages import Stage  # noqa: E402
from understudy.teaching_trials import TRAJECTORY, Trial  # noqa: E402
from understudy.types import Frame  # noqa: E402

VOID = {"meta", "link", "img", "br", "hr", "input"}


class Page(HTMLParser):
    """What a page is made of; fails where tags are not closed."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.rows: list[list[str]] = []
        self.feed(text)
        self.close()
        assert not self.open, self.open

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words.append(data)
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data

    def addresses(self) -> list[str]:
        return [v or "" for _, a in self.tags for k, v in a.items() if k in ("src", "href", "poster", "data", "action")]

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def _recorded(folder: Path, d: Demonstration, camera: object) -> Path:
    """A recording of grey frames at the demonstration's times, as many as it has samples divided by five."""
    frames = [
        Frame(np.full((540, 960, 3), 100 + i, np.uint8), np.full((540, 960), 2, np.float32), camera, i, float(t))
        for i, t in enumerate(d.times_s[::5])
    ]
    return write_recording(folder, frames)


def _trial(folder: Path, number: int = 0, success: bool = True) -> Trial:
    folder = folder / f"{number:03d}"
    folder.mkdir(parents=True, exist_ok=True)
    t = np.linspace(0, 10, 50)
    np.savez(folder / TRAJECTORY, times_s=t, opened=0.03 * t, force=5 + t, opening_m=0.09 - 0.01 * t)
    (folder / "video.mp4").write_bytes(b"\0" * 1000)
    reason, detail = ("opened", "98 % of the goal") if success else ("no feasible motion", "the <wall> is near")
    return Trial(folder, number, success, reason, detail, 0.98 if success else 0.0, 0, 20.0, 10.0, 7)


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Teaching:
    """A teaching with two recordings, of which one held nothing, and one trial; nothing was estimated."""
    from understudy.camera import Camera, RGBDCamera

    folder = tmp_path_factory.mktemp("taught")
    camera = RGBDCamera.aligned(Camera(960, 540, np.array([[540.7, 0, 479.5], [0, 540.7, 269.5], [0, 0, 1.0]])))
    d = scenes.demonstration("drawer", samples=60)
    d = replace(d, source={"recording": str(_recorded(folder / "recording", d, camera))})
    own = folder / "demonstrations/one"
    PeopleFile("m", "r", tuple(FramePeople(i, (), None) for i in range(12))).write(own / "people/people.json")
    (own / "demonstration.png").write_bytes(plots.plot(d))
    adaptation = teaching_scenes.as_if_adapted([d])
    motions = tuple(robot_motions([d], adaptation))
    return Teaching(
        folder,
        "drawer",
        "pr2_right",
        (Seen("one", "one"), Seen("<b>two</b>", "two", "nobody & nothing")),
        (d,),
        adaptation,
        evaluate([d], adaptation, scenes.platform(0.005)),
        motions,
        Skill(learn(motions), "drawer", "pr2_right"),
        (_trial(folder / "trials"),),
        {
            "demonstrate": Stage("a", True, 30.0, 20.0),
            "adapt": Stage("b", True, 3.0, 2.0, resumed=True),
            "learn": Stage("c", True, 1.0, 1.0),
            "trial 000": Stage("d", True, 65.0, 2.0),
        },
        (),
    )


@pytest.fixture(scope="module")
def page(taught: Teaching) -> Page:
    return Page(report.write(taught).read_text(encoding="utf-8"))


def test_it_needs_nothing_else(taught: Teaching, page: Page) -> None:
    assert taught.report.stat().st_size <= 8e6
    assert all(address.startswith("data:") for address in page.addresses())
    names = {tag for tag, _ in page.tags}
    assert not names & {"script", "iframe", "object", "embed", "base"}
    assert not any(k.startswith("on") for _, a in page.tags for k in a)
    style = taught.report.read_text().split("<style>")[1].split("</style>")[0]
    assert "url(" not in style and "@import" not in style
    assert "prefers-color-scheme: dark" in style and "@media print" in style


def test_all_pictures_are_pictures(page: Page) -> None:
    images = [a for tag, a in page.tags if tag == "img"]
    assert len(images) >= 8 + 1 + 1 + 1  # frames, demonstration, model, curves
    for image in images:
        content = base64.b64decode((image["src"] or "").split(",")[1])
        decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        assert decoded.shape[:2] == (int(image["height"] or 0), int(image["width"] or 0))
        assert image["alt"]
    video = next(a for tag, a in page.tags if tag == "video")
    assert {"controls", "muted", "loop"} <= video.keys()
    assert base64.b64decode((video["src"] or "").split(",")[1]) == b"\0" * 1000


def test_it_says_what_happened(taught: Teaching, page: Page) -> None:
    assert "The robot did it: opened to 98 % of the goal in 10.0 s, at the first attempt" in page.text
    assert "<b>two</b>: nobody & nothing" in page.text and "bends <nothing>" in page.text
    rows = {row[0]: row[1:] for row in page.rows if row}
    for name, words in {**ROWS, **MORE}.items():
        before, after, *_ = rows[words]
        for cell, when in ((before, "before"), (after, "after")):
            value = getattr(taught.metrics[when], name)
            assert cell == "-" if np.isnan(value) else float(cell) == pytest.approx(value, abs=0.51e-2, rel=5e-3), words
    assert rows["std gripper-object, deg"][2] == "0.06"  # the paper's drawer
    assert rows["adaptation to the robot"][:2] == ["at least 3.0 s", "2.0 s"]
    assert "99 s from the recordings" in page.text
    assert rows["one"][:3] == ["60", "right", "100 %"]


@pytest.mark.parametrize(
    ("outcomes", "kind", "words"),
    [
        ((), "", "Learnt. The skill was not tried in simulation."),
        ((False,), "bad", "The robot did not do it: no feasible motion (the <wall> is near)"),
        ((True, True), "good", "The robot did it in all of 2 trials"),
        ((True, False, True), "good", "The robot did it in 2 of 3 trials in simulation. Else: no feasible motion."),
        ((False, False, True), "bad", "The robot did it in 1 of 3 trials"),
    ],
)
def test_verdicts(taught: Teaching, outcomes: tuple[bool, ...], kind: str, words: str) -> None:
    trials = tuple(_trial(taught.folder / "other", i, success) for i, success in enumerate(outcomes))
    teaching = replace(taught, outcomes=trials)
    said = verdict(teaching)
    assert said[0] == kind
    assert " ".join(said[1:]).startswith(words)
    text = Page(reproduced(teaching)).text
    assert text.count("the <wall> is near") == outcomes.count(False)
    if len(trials) > 1:
        low, high = wilson_interval(sum(outcomes), len(outcomes))
        assert f"{low:.0%} to {high:.0%}" in text


def test_many_demonstrations_still_fit(taught: Teaching) -> None:
    many = replace(
        taught,
        seen=tuple(Seen(f"r{i}", "one") for i in range(12)),
        demonstrations=taught.demonstrations * 12,
        motions=taught.motions * 12,
        adaptation=teaching_scenes.as_if_adapted(taught.demonstrations * 12),
    )
    text = report.page(many)
    assert len(text) <= 8e6
    images = [a for tag, a in Page(text).tags if tag == "img" and (a["alt"] or "").startswith("frame at")]
    assert len(images) == 3 * 4


def test_frames_show_grasp_and_release(taught: Teaching) -> None:
    (d,) = taught.demonstrations
    shown = pictures.watched_frames(taught.folder / "demonstrations/one", d, 6)
    assert len(shown) == 6
    assert [p.caption.split(", ")[1] for p in shown] == sorted(
        (p.caption.split(", ")[1] for p in shown), key=["reach", "manipulate", "release"].index
    )
    seconds = [float(p.caption.split(" s")[0]) for p in shown]
    for sample in (d.segments.grasp, d.segments.release):
        assert min(abs(s - (d.times_s[sample] - d.times_s[0])) for s in seconds) <= 0.26


def test_a_recording_that_is_gone_is_no_failure(taught: Teaching) -> None:
    (d,) = taught.demonstrations
    moved = replace(taught, demonstrations=(replace(d, source={"recording": "/not/there"}),))
    assert "Its frames cannot be shown" in Page(report.page(moved)).text
