"""Puts the report together. Everything is in the one file: style, images, video; it needs no network and no script."""

from __future__ import annotations

from html import escape
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, Final

from understudy.benchmark.environment import environment
from understudy.files import write_atomically
from understudy.report.sections import SECTIONS, made_with, summary

if TYPE_CHECKING:
    from understudy.teaching import Teaching

_PACKAGES: Final = ("mujoco", "pin", "scikit-learn", "numba")


def write(teaching: Teaching) -> Path:
    """Writes `teaching.report`, whole or not at all."""
    write_atomically(teaching.report, page(teaching))
    return teaching.report


def page(teaching: Teaching) -> str:
    """The HTML."""
    facts = _facts()
    kind, word, words = verdict(teaching)
    template = files("understudy.report")
    return Template((template / "page.html").read_text(encoding="utf-8")).substitute(
        title=escape(f"{teaching.task.replace('_', ' ').capitalize()}, taught to {teaching.robot}"),
        style=(template / "style.css").read_text(encoding="utf-8"),
        verdict_kind=kind,
        verdict_word=escape(word),
        verdict=escape(words),
        tiles=summary(teaching),
        sections="\n".join([*(make(teaching) for make in SECTIONS), made_with(teaching, facts)]),
        version=escape(str(facts["versions"]["understudy"])),
        created=escape(str(facts["created"])),
    )


def verdict(teaching: Teaching) -> tuple[str, str, str]:
    """Did the robot do it? A class of the style, a word, and the rest of the sentence."""
    t = teaching
    if not t.outcomes:
        return "", "Learnt.", "The skill was not tried in simulation."
    done = sum(o.success for o in t.outcomes)
    if len(t.outcomes) == 1:
        o = t.outcomes[0]
        how = f"opened to {100 * o.opened_share:.0f} % of the goal in {o.duration_s:.1f} s"
        tries = "at the first attempt" if o.retries == 0 else f"with {o.retries} more attempt{'s'[: o.retries > 1]}"
        if o.success:
            return "good", "The robot did it:", f"{how}, {tries}, in simulation."
        return "bad", "The robot did not do it:", f"{o.reason} ({o.detail}); {how}."
    if done == len(t.outcomes):
        return "good", "The robot did it", f"in all of {done} trials in simulation."
    reasons = sorted({o.reason for o in t.outcomes if not o.success})
    word = f"The robot did it in {done} of {len(t.outcomes)} trials"
    return ("good" if 2 * done > len(t.outcomes) else "bad"), word, f"in simulation. Else: {', '.join(reasons)}."


def _facts() -> dict[str, Any]:
    facts: dict[str, Any] = environment()
    for package in _PACKAGES:
        try:
            facts["versions"][package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return facts
