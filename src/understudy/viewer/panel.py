"""The side panel: the image, the frame slider and playing, what is shown, and a line on each person."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from understudy.overlay import person_color, torso_distance
from understudy.types import INFERRED, MISSING, OBSERVED, Person
from understudy.viewer.results import Moment
from understudy.viewer.scene import GROUPS


@runtime_checkable
class Controls(Protocol):
    """What the panel asks of the viewer."""

    def go_to(self, position: int) -> None: ...
    def step(self, by: int) -> None: ...
    def toggle_playing(self) -> None: ...
    def set_fps(self, fps: float) -> None: ...
    def set_visible(self, group: str, shown: bool) -> None: ...
    def set_point_size(self, metres: float) -> None: ...
    def set_see_through(self, on: bool) -> None: ...


class Panel:
    """The widgets and what they show."""

    def __init__(self, gui: Any, controls: Controls, *, title: str, frames: int, fps: float, point_size_m: float):
        self._frames = frames
        gui.set_panel_label(title)
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", dark_mode=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(430)
        self._image = gui.add_image(np.full((9, 16, 3), 230, np.uint8), format="jpeg")
        self._status = gui.add_html("")
        self._add_frames(gui, controls, fps)
        with gui.add_folder("People"):
            self._people = gui.add_html("")
        with gui.add_folder("Show"):
            self._add_shown(gui, controls, point_size_m)

    def _add_frames(self, gui: Any, controls: Controls, fps: float) -> None:
        several = self._frames > 1
        self.slider = gui.add_slider("Frame", 1, max(2, self._frames), 1, 1, visible=several)
        self._steps = gui.add_button_group("Step", ("Previous", "Next"), visible=several)
        self._play = gui.add_button("Play", visible=several)
        self._fps = gui.add_slider("Speed (frames/s)", 1.0, 30.0, 1.0, float(round(fps)), visible=several)
        _on(self.slider.on_update, lambda: controls.go_to(int(self.slider.value) - 1))
        _on(self._steps.on_click, lambda: controls.step(1 if self._steps.value == "Next" else -1))
        _on(self._play.on_click, controls.toggle_playing)
        _on(self._fps.on_update, lambda: controls.set_fps(self._fps.value))

    def _add_shown(self, gui: Any, controls: Controls, point_size_m: float) -> None:
        for group in (*GROUPS, "image"):
            box = gui.add_checkbox(group.capitalize(), True)
            _on(box.on_update, partial(self._set_visible, controls, group, box))
        through = gui.add_checkbox("See-through people", True)
        _on(through.on_update, lambda: controls.set_see_through(through.value))
        size = gui.add_slider("Point size (mm)", 2.0, 40.0, 1.0, 1000 * point_size_m)
        _on(size.on_update, lambda: controls.set_point_size(size.value / 1000))

    def _set_visible(self, controls: Controls, group: str, box: Any) -> None:
        if group == "image":
            self._image.visible = box.value
        else:
            controls.set_visible(group, box.value)

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        return np.asarray(self._image.image)

    @property
    def status(self) -> str:
        return str(self._status.content)

    @property
    def people(self) -> str:
        return str(self._people.content)

    def playing(self, playing: bool) -> None:
        self._play.label = "Pause" if playing else "Play"

    def show(self, moment: Moment, position: int) -> None:
        """Words and image of a frame."""
        if moment.overlay is not None:
            self._image.image = moment.overlay
        else:
            self._image.image = _empty(self._image.image)
        self._status.content = status_html(moment, position, self._frames)
        self._people.content = people_html(moment.frame.people, known=moment.frame.skipped is None)


def _on(register: Callable[[Callable[[Any], None]], object], act: Callable[[], None]) -> None:
    """Calls `act` when a person (not the program) has moved the widget."""

    def changed(event: Any) -> None:
        if event.client is not None:
            act()

    register(changed)


def _empty(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.full_like(image, 230)


_BOX = "font-size:0.9em;line-height:1.5;padding:0.4em 1em"


def status_html(moment: Moment, position: int, frames: int) -> str:
    """Which frame this is, when, and what went wrong."""
    time = moment.frame.timestamp_s
    when = "" if time is None else f" at {time:.2f} s"
    html = f"<b>Frame {moment.frame.index}</b>{when} ({position + 1} of {frames})"
    if moment.problem is not None:
        html += f'<div style="color:#b3261e">{escape(moment.problem)}</div>'
    return f'<div style="{_BOX}">{html}</div>'


def people_html(people: tuple[Person, ...], *, known: bool = True) -> str:
    """One line per person: colour, id, torso distance, number of joints by source; or why there are none."""
    nobody = "Nobody in this frame." if known else "Not looked at."
    lines = []
    for person in people:
        r, g, b = person_color(person.id)
        swatch = f'<span style="color:rgb({r},{g},{b});font-size:1.3em;-webkit-text-stroke:0.5px #222">●</span>'
        lines.append(f"<div>{swatch} <b>#{person.id}</b> {escape(describe_joints(person))}</div>")
    return f'<div style="{_BOX}">{"".join(lines) or nobody}</div>'


def describe_joints(person: Person) -> str:
    """'3.61 m: 15 observed, 3 inferred', or 'failed: why'."""
    if person.failed is not None:
        return f"failed: {person.failed}"
    count = Counter(person.source)
    parts = [f"{count[source]} {source}" for source in (OBSERVED, INFERRED, MISSING) if count[source]]
    distance = torso_distance(person)
    return (f"{distance:.2f} m: " if distance is not None else "") + ", ".join(parts)
