"""The report's sections, each from a teaching to HTML."""

from __future__ import annotations

import math
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from understudy.adaptation.metrics import MORE, PAPER, ROWS
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.run import PICTURE
from understudy.demonstration.tasks import TASKS
from understudy.errors import MissingExtraError, UnderstudyError
from understudy.objects.articulation import PRISMATIC, REVOLUTE, Articulation
from understudy.report.markup import Cell, bar, figure, notes, paragraph, section, table, tiles, uri
from understudy.report.pictures import image_size, watched_frames
from understudy.report.plots import trial_curves
from understudy.teaching_folder import ADAPTATION, DEMONSTRATIONS
from understudy.teaching_trials import load_curves

if TYPE_CHECKING:
    from understudy.teaching import Teaching

SHOWN: Final = 3
"""demonstrations that are shown with frames and trajectories; the others only in the table"""

_FRAMES: Final = (8, 6, 4)  # of each, with 1, 2, 3 demonstrations
_GREATEST_IMAGE: Final = 700_000  # bytes
_STAGES: Final = {
    "demonstrate": "people, hands, object and surroundings from the frames",
    "adapt": "adaptation to the robot",
    "learn": "action model",
}


def summary(teaching: Teaching) -> str:
    """Numbers at a glance."""
    t, after, before = teaching, teaching.metrics["after"], teaching.metrics["before"]
    pairs = [
        (f"{len(t.demonstrations)} of {len(t.seen)}", "recordings that the skill was learnt from"),
        (
            f"{before.achievable_percent:.0f} → {after.achievable_percent:.0f} %",
            "achievable, before → after adaptation",
        ),
        (f"{after.hand_cm:.1f} cm", "gripper from the hand that it follows, mean"),
    ]
    if t.outcomes:
        done = sum(o.success for o in t.outcomes)
        pairs.append((f"{done} of {len(t.outcomes)}", "trials in simulation succeeded"))
    pairs.append((_seconds(sum(s.seconds for s in t.timings.values())), "from the recordings to this report"))
    return tiles(pairs)


def watched(teaching: Teaching) -> str:
    """What was seen: frames with skeletons, trajectories, and what was left out."""
    t = teaching
    used = [s for s in t.seen if not s.failed]
    rows = [_demonstration_row(s.name, d) for s, d in zip(used, t.demonstrations, strict=True)]
    heads = ("recording", "samples", "hand", "hand seen", "object", "moved", "reach", "manipulate", "release")
    parts = [table(heads, rows)]
    left_out = [s for s in t.seen if s.failed]
    if left_out:
        parts += [paragraph("Left out:"), notes(f"{s.recording}: {s.failed}" for s in left_out)]
    shown = list(zip(used, t.demonstrations, strict=True))[:SHOWN]
    for s, d in shown:
        folder = t.folder / DEMONSTRATIONS / s.name
        parts += [f"<h3>{escape(s.name)}</h3>", _frames(folder, d, _FRAMES[len(shown) - 1])]
        words = "Trajectories of hand, torso and handle: over the image, from above, and over time."
        parts.append(_image(folder / PICTURE, f"trajectories of {s.name}", words))
    if len(t.demonstrations) > SHOWN:
        parts.append(paragraph(f"The pictures of the others are in {DEMONSTRATIONS}/.", "quiet"))
    return section("watched", "What was watched", *parts)


def adapted(teaching: Teaching) -> str:
    """The paper's ten rows before and after, and pictures."""
    t = teaching
    column = TASKS.index(t.task) if t.task in TASKS else None
    heads = ["", "before", "after"] + (["2018 paper"] if column is not None else [])
    rows = []
    for name, words in {**ROWS, **MORE}.items():
        row = [words, *(_digits(getattr(t.metrics[when], name)) for when in ("before", "after"))]
        if column is not None:
            paper = PAPER["RGB-D"].get(name)
            row.append(_digits(paper[column]) if paper else "")
        rows.append(row)
    parts = [
        paragraph(
            "Before: gripper and base where the teacher's hand and torso were. After: as near to that as the robot can "
            "be, with the grasp kept, within reach and clear of what stands around."
        ),
        table(heads, rows),
    ]
    if column is not None:
        words = (
            "The 2018 paper's values are optimised ones, of its own recordings with an RGB-D camera; blank: not known."
        )
        parts.append(paragraph(words, "quiet"))
    parts.append(notes(t.adaptation.report.notes))
    for i in range(min(SHOWN, len(t.demonstrations))):
        words = "Teacher and robot from above and from the side; below, what was bent when."
        parts.append(_image(t.folder / ADAPTATION / f"{i:03d}.png", "adapted trajectories", words))
    return section("adapted", f"What {t.robot} makes of it", *parts)


def learnt(teaching: Teaching) -> str:
    """The action model."""
    from understudy.actions.plots import action_model

    t, model = teaching, teaching.skill.model
    durations = ", ".join(f"{name} {s.duration_s[0]:.1f} s" for name, s in model.segments.items())
    components = ", ".join(f"{name} {len(s.mixture)}" for name, s in model.segments.items())
    words = f"Learnt from {_count(model.demonstrations, 'demonstration')}. {durations}. Components: {components}."
    try:
        picture = action_model(model, t.motions, f"{t.task}, {t.robot}")
        caption = "Paths with ellipses of two standard deviations, in the frame of the handle; features over the phase."
        drawn = figure(picture, "the action model", caption, image_size(picture))
    except MissingExtraError as e:
        drawn = paragraph(str(e), "quiet")
    return section("learnt", "What was learnt", paragraph(words), drawn)


def reproduced(teaching: Teaching) -> str:
    """Video and table of the trials."""
    from understudy.execution.trials import wilson_interval

    t = teaching
    if not t.outcomes:
        words = "It was not tried in simulation."
        return section("reproduced", "What the robot did", paragraph(words), notes(t.notes))
    first = t.outcomes[0]
    parts = [
        paragraph(
            "In simulated physics with frictional fingers: furniture of other dimensions than the demonstrated one, "
            "another place to start from, and errors of localisation of 2 cm and 2 degrees."
        )
    ]
    film = ""
    if first.video is not None:
        address = uri(first.video.read_bytes(), "video/mp4")
        film = f'<video controls autoplay muted loop playsinline src="{address}"></video>'
    try:
        curves = trial_curves(load_curves(first.folder), t.skill.model.object.articulation.kind == REVOLUTE)
        drawn = figure(curves, "opening and force over time", size=image_size(curves))
    except MissingExtraError:
        drawn = ""  # plots are optional
    parts.append(f'<div class="beside">{film}{drawn}</div>')
    if first.sheet is not None:
        sheet = first.sheet.read_bytes()
        words = "Frames of the video, evenly over the time."
        parts.append(figure(sheet, "frames of the video", words, image_size(sheet)))
    if first.note:
        parts.append(paragraph(first.note, "quiet"))
    heads = ("trial", ("result", "left"), "opened", "simulated", "greatest force", "retries", ("detail", "left"))
    rows: list[list[Cell]] = [
        [
            str(o.number),
            (escape(o.reason), "left good" if o.success else "left bad"),
            f"{100 * o.opened_share:.0f} %",
            f"{o.duration_s:.1f} s",
            f"{o.max_force_n:.0f} N",
            str(o.retries),
            (escape(o.detail), "left"),
        ]
        for o in t.outcomes
    ]
    parts.append(table(heads, rows))
    if len(t.outcomes) > 1:
        done = sum(o.success for o in t.outcomes)
        low, high = wilson_interval(done, len(t.outcomes))
        parts.append(
            paragraph(f"{done} of {len(t.outcomes)} succeeded (95 % interval, Wilson: {low:.0%} to {high:.0%}).")
        )
    return section("reproduced", "What the robot did", *parts)


def timings(teaching: Teaching) -> str:
    """How long each stage took."""
    stages = teaching.timings
    trials = [s for name, s in stages.items() if name not in _STAGES]
    entries = [(words, [stages[name]]) for name, words in _STAGES.items() if name in stages]
    if trials:
        entries.append((f"{_count(len(trials), 'trial')} in simulation, with video", trials))
    most = max((sum(s.seconds for s in parts) for _, parts in entries), default=0.0)
    rows: list[list[Cell]] = []
    for words, parts in entries:
        seconds, processor = sum(s.seconds for s in parts), sum(s.process_seconds for s in parts)
        least = "at least " if any(s.resumed for s in parts) else ""
        width = 100 * seconds / most if most > 0 else 0.0
        rows.append([words, f"{least}{_seconds(seconds)}", _seconds(processor), (bar(width), "wide left")])
    parts_ = [table(("stage", "by the clock", "processor", ""), rows)]
    if any(s.resumed for s in stages.values()):
        parts_.append(
            paragraph("At least: the run was interrupted; what the stopped run had spent is not counted.", "quiet")
        )
    return section("timings", "How long it took", *parts_)


def made_with(teaching: Teaching, facts: dict[str, Any]) -> str:
    """Command, versions, hardware, and what lies where."""
    versions = ", ".join(f"{name} {version}" for name, version in facts["versions"].items() if version)
    hardware = f"{facts['hardware']['cpu']}, {facts['hardware']['cores']} cores, {facts['hardware']['system']}"
    parts = [
        f"<pre>{escape(str(facts['command']))}</pre>",
        table(("", ""), [["versions", (escape(versions), "left")], ["machine", (escape(hardware), "left")]]),
        paragraph(
            "Beside this file: skill.json and skill.npz (the skill), config.json (all settings), demonstrations/, "
            "adaptation/, trials/ and stages.json (what was made from what). Run the command again to go on after an "
            "interruption; what is finished is not made again."
        ),
    ]
    return section("made", "How it was made", *parts)


def _demonstration_row(name: str, d: Demonstration) -> list[str]:
    dt = (d.times_s[-1] - d.times_s[0]) / max(len(d) - 1, 1)
    spans = [f"{(part.stop - part.start) * dt:.1f} s" for part in d.segments.slices(len(d)).values()]
    seen = f"{100 * d.hand.observed.mean():.0f} %"
    return [name, str(len(d)), d.acting, seen, d.articulation.kind, _way(d.articulation), *spans]


def _way(a: Articulation) -> str:
    low, high = a.range
    ways = {REVOLUTE: f"{math.degrees(high - low):.0f}°", PRISMATIC: f"{100 * (high - low):.0f} cm"}
    return ways.get(a.kind, "-")


def _frames(folder: Path, d: Demonstration, count: int) -> str:
    try:
        pictures = watched_frames(folder, d, count)
    except UnderstudyError as e:
        return paragraph(f"Its frames cannot be shown: {e}", "quiet")
    figures = "\n".join(figure(p.content, f"frame at {p.caption}", p.caption, p.size) for p in pictures)
    return f'<div class="frames">\n{figures}\n</div>'


def _image(path: Path, alt: str, caption: str) -> str:
    """A picture that a stage drew; nothing where it did not (matplotlib is optional), or one that is too large."""
    content = path.read_bytes() if path.exists() else b""
    if not content or len(content) > _GREATEST_IMAGE:
        return ""
    return figure(content, alt, caption, image_size(content))


def _digits(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    return f"{value:.4f}" if 0 < abs(value) < 0.01 else f"{value:.2f}" if abs(value) < 99.995 else f"{value:.0f}"


def _seconds(value: float) -> str:
    if value < 10:
        return f"{value:.1f} s"
    return f"{value:.0f} s" if value < 100 else f"{int(value) // 60} min {int(value) % 60} s"


def _count(n: int, thing: str) -> str:
    return f"{n} {thing}{'' if n == 1 else 's'}"


SECTIONS: Final[tuple[Callable[[Teaching], str], ...]] = (reproduced, watched, adapted, learnt, timings)
"""In the order in which they are read: what a reader wants to know first, first."""
