"""Teaches a robot: recordings of a person who opens something in, a skill that a robot has tried out.

    OUT/skill.json, skill.npz    the skill (`actions.load_skill`)
    OUT/report.html              everything that came of it, in one file
    OUT/demonstrations/NAME/     what was seen in each recording (`demonstration.storage`)
    OUT/adaptation/              what the robot makes of it (`adaptation.storage`)
    OUT/trials/000/              what the robot did in simulation
    OUT/config.json, stages.json settings; what is finished, made from what, and how long it took

`Course.run` names the stages in order. Killed anywhere and started again, it goes on where it was.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tqdm import tqdm

import understudy
from understudy import methods
from understudy.adaptation.adapt import AdaptConfig
from understudy.adaptation.metrics import Metrics
from understudy.adaptation.most import adapt_most
from understudy.adaptation.result import AdaptationResult
from understudy.demonstration.build import DemonstrationConfig
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.run import demonstrate
from understudy.demonstration.tasks import TASKS
from understudy.errors import UnderstudyError
from understudy.files import write_atomically
from understudy.teaching_folder import (
    ADAPTATION,
    CONFIG,
    DEMONSTRATIONS,
    FORMAT,
    REPORT,
    TRIALS,
    Seen,
    arrays,
    load_adaptation,
    load_left_out,
    load_seen,
    load_shown,
    require_ours,
    robot_named,
    save_adaptation,
    save_seen,
    skill_files,
    state_of,
)
from understudy.teaching_motions import robot_motions, too_short
from understudy.teaching_stages import Stage, Stages, digest, plain
from understudy.teaching_trials import TRIAL, Trial, layouts, load_trial, run_trial

if TYPE_CHECKING:
    from understudy.actions import RobotMotion, Skill


@dataclass(frozen=True)
class TeachConfig:
    """Settings of all stages. The defaults are meant for all tasks."""

    demonstration: DemonstrationConfig = field(default_factory=DemonstrationConfig)
    """its `task` is replaced by the one that is taught"""
    adaptation: AdaptConfig = field(default_factory=AdaptConfig)
    method: str = methods.DEFAULT
    detector: str = "blazepose"
    hands: str = "full"
    weights: Path | None = None
    trials: int = 1
    """in simulation, each with other furniture; 0: none"""
    film: bool = True
    """the first trial: a video, where OpenGL is there (it takes several times as long)"""
    seed: int = 0
    """of learning and trials"""

    def __post_init__(self) -> None:
        if self.trials < 0 or self.seed < 0:
            raise UnderstudyError(f"trials and seed must be 0 or more, got {self.trials} and {self.seed}")


@dataclass(frozen=True, eq=False)
class Teaching:
    """Everything that came of it."""

    folder: Path
    task: str
    robot: str
    seen: tuple[Seen, ...]
    """all recordings, also those that were left out"""
    demonstrations: tuple[Demonstration, ...]
    """of the recordings that were not left out"""
    adaptation: AdaptationResult
    metrics: dict[str, Metrics]
    """'before' and 'after' adaptation"""
    motions: tuple[RobotMotion, ...]
    """what the skill was learnt from"""
    skill: Skill
    outcomes: tuple[Trial, ...]
    timings: dict[str, Stage]
    notes: tuple[str, ...]
    """what a user should know"""

    @property
    def report(self) -> Path:
        """The HTML file."""
        return self.folder / REPORT


def teach(
    recordings: Sequence[str | Path],
    out: str | Path,
    *,
    task: str,
    robot: str = "pr2",
    config: TeachConfig | None = None,
    progress: bool = True,
) -> Teaching:
    """Recordings -> demonstrations -> adapted to the robot -> skill -> tried in simulation -> report.

    recordings: of people who do the same `task` (one is enough). robot: a robot's name, or its description.json.
    Recordings in which no demonstration is found, and demonstrations that the robot cannot do, are left out; the result
    says why. Raises UnderstudyError when none is left, or `out` holds something else; MissingExtraError without the
    extra 'robot'.
    """
    if not recordings:
        raise UnderstudyError("teach: needs at least one recording")
    return Course(recordings, Path(out), task, robot, config or TeachConfig(), progress).run()


class Course:
    """One call of `teach`."""

    def __init__(
        self,
        recordings: Sequence[str | Path],
        out: Path,
        task: str,
        robot: str,
        config: TeachConfig,
        progress: bool = True,
    ):
        self.recordings, self.out, self.task = list(dict.fromkeys(map(str, recordings))), out, task
        self.config = replace(config, demonstration=replace(config.demonstration, task=task))
        self.progress, self.notes = progress, list[str]()
        self.robot_name, (self.robot, self.platform) = robot, robot_named(robot)
        require_ours(out)
        settings = {"task": task, "robot": robot, "recordings": self.recordings, **plain(self.config)}
        version = {"format": FORMAT, "understudy": understudy.__version__}
        write_atomically(out / CONFIG, json.dumps(version | settings, indent=1) + "\n")
        self.stages = Stages(out)

    def run(self) -> Teaching:
        """All stages, in order. Each is skipped if it was done before from the same."""
        with self.shown("demonstrate"):
            seen, shown = self.demonstrate()
        with self.shown("adapt"):
            seen, demonstrations, adaptation, metrics = self.adapt(seen, shown)
        with self.shown("learn"):
            motions, skill = self.learn(demonstrations, adaptation)
        with self.shown("reproduce"):
            trials = self.reproduce(skill)
        timings = {name: stage for name, stage in self.stages.entries.items() if stage.finished}
        notes = (*adaptation.report.notes, *self.notes)
        teaching = Teaching(
            self.out, self.task, self.robot.name, seen, demonstrations, adaptation, metrics, motions, skill, trials,
            timings, notes,
        )  # fmt: skip
        with self.shown("report"):
            from understudy import report

            report.write(teaching)
        return teaching

    def demonstrate(self) -> tuple[tuple[Seen, ...], tuple[Demonstration, ...]]:
        """People, hands, the moved object and the surroundings, from each recording's frames."""
        c, folder = self.config, self.out / DEMONSTRATIONS

        def make() -> tuple[Seen, ...]:
            results = demonstrate(
                self.recordings, folder, c.demonstration, method=c.method, detector=c.detector, hands=c.hands,
                weights=c.weights, progress=self.progress,
            )  # fmt: skip
            return save_seen(folder, results)

        files = [state_of(recording) for recording in self.recordings]
        key = digest(self.recordings, files, c.demonstration, c.method, c.detector, c.hands, str(c.weights), _VERSION)
        seen = self.stages.run("demonstrate", key, lambda: load_seen(folder), make)
        if all(s.failed for s in seen):
            reasons = "".join(f"\n  {s.recording}: {s.failed}" for s in seen)
            raise UnderstudyError(f"teach: no recording shows a demonstration:{reasons}")
        return seen, load_shown(folder, seen)

    def adapt(
        self, seen: tuple[Seen, ...], shown: tuple[Demonstration, ...]
    ) -> tuple[tuple[Seen, ...], tuple[Demonstration, ...], AdaptationResult, dict[str, Metrics]]:
        """Gripper and base trajectories that the robot can do, near to what was shown."""
        folder, used = self.out / ADAPTATION, [s for s in seen if not s.failed]

        def make() -> dict[str, str]:
            shutil.rmtree(folder, ignore_errors=True)
            result, left_out = self.feasible(used, shown)
            kept = [d for s, d in zip(used, shown, strict=True) if s.name not in left_out]
            save_adaptation(folder, kept, result, self.platform, left_out)
            return left_out

        facts = [[s.name, d.segments, d.articulation, d.handle, d.acting] for s, d in zip(used, shown, strict=True)]
        key = digest(
            *arrays(self.out / DEMONSTRATIONS, used), facts, self.robot.checksum, self.config.adaptation, _VERSION
        )
        left_out = self.stages.run("adapt", key, lambda: load_left_out(folder), make)
        seen = tuple(replace(s, failed=left_out.get(s.name, s.failed)) for s in seen)
        kept = tuple(d for s, d in zip(used, shown, strict=True) if s.name not in left_out)
        return seen, kept, *load_adaptation(folder)

    def feasible(self, used: Sequence[Seen], shown: Sequence[Demonstration]) -> tuple[AdaptationResult, dict[str, str]]:
        """The adaptation, and demonstrations (name, reason) that were left out for it."""
        pairs = list(zip(used, shown, strict=True))
        left_out = {s.name: why for s, d in pairs if (why := too_short(d))}
        if len(left_out) == len(pairs):
            raise UnderstudyError(f"teach: nothing can be learnt: {'; '.join(left_out.values())}")
        long = [(s.name, d) for s, d in pairs if s.name not in left_out]
        result, refused = adapt_most([d for _, d in long], self.platform, config=self.config.adaptation)
        return result, left_out | {long[i][0]: why for i, why in refused.items()}

    def learn(
        self, demonstrations: Sequence[Demonstration], adaptation: AdaptationResult
    ) -> tuple[tuple[RobotMotion, ...], Skill]:
        """A model of gripper, base and torso over time, in the frame of the object."""
        from understudy.actions import Skill, learn, load_skill, save_skill

        motions = tuple(robot_motions(demonstrations, adaptation))

        def make() -> Skill:
            model = learn(motions, seed=self.config.seed)
            names = [str(d.source.get("recording", "")) for d in demonstrations]
            skill = Skill(
                model, self.task, self.robot.name, {"recordings": names, "understudy": understudy.__version__}
            )
            save_skill(self.out, skill)
            return skill

        key = digest([plain(m) for m in motions], self.config.seed, _VERSION)
        return motions, self.stages.run("learn", key, lambda: load_skill(self.out), make)

    def reproduce(self, skill: Skill) -> tuple[Trial, ...]:
        """The robot tries the skill on furniture that it has not seen, in physics."""
        folder, count = self.out / TRIALS, self.config.trials
        if count and self.task not in TASKS:
            self.notes.append(f"not tried in simulation: there is no furniture for the task {self.task!r}")
            count = 0
        content, trials = skill_files(self.out), list[Trial]()
        setups = layouts(self.task, count, self.config.seed)
        for number, setup in enumerate(tqdm(setups, "trials", unit="trial", disable=not self.progress or count < 2)):
            place, film = folder / f"{number:03d}", self.config.film and number == 0
            key = digest(*content, self.robot.checksum, plain(setup), film, _VERSION)

            make = partial(run_trial, skill, self.robot_name, setup, number, place, film=film)
            trials.append(self.stages.run(f"{_TRIAL}{number:03d}", key, partial(load_trial, place), make))
        for old in sorted(folder.glob(f"*/{TRIAL}"))[count:]:  # of an earlier run with more trials
            shutil.rmtree(old.parent)
        names = {f"{_TRIAL}{number:03d}" for number in range(count)} | {"demonstrate", "adapt", "learn"}
        self.stages.keep(names)
        return tuple(trials)

    @contextmanager
    def shown(self, stage: str) -> Iterator[None]:
        """Says on stderr which stage runs."""
        number = STAGES.index(stage) + 1
        if self.progress:
            tqdm.write(f"[{number}/{len(STAGES)}] {stage}: {_WORDS[stage]}", file=sys.stderr)
        yield


_WORDS: Final = {
    "demonstrate": "people, hands and the moved object in the frames",
    "adapt": "into what the robot can do",
    "learn": "the action model",
    "reproduce": "the robot tries it in simulation",
    "report": "what came of it",
}
STAGES: Final = tuple(_WORDS)
_TRIAL: Final = "trial "
_VERSION: Final = understudy.__version__
