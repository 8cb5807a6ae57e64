"""From a run's folder to what is shipped: weights, the file for the light runtime, a model card (torch, onnx)."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from understudy.errors import UnderstudyError
from understudy.files import read_json, write_atomically
from understudy.synthetic.samples import Batch
from understudy.voxelposenet import records
from understudy.voxelposenet.calibration import apply, fit
from understudy.voxelposenet.checkpoint import load_net, save_weights
from understudy.voxelposenet.data import Batches
from understudy.voxelposenet.export import export_onnx
from understudy.voxelposenet.net import VoxelPoseNet
from understudy.voxelposenet.paper_net import load_paper_net
from understudy.voxelposenet.train_config import TrainConfig
from understudy.voxelposenet.training import CONFIG, WEIGHTS, read_config
from understudy.voxelposenet.validation import collect, summary

CARD: Final = "MODEL_CARD.md"
_NAME: Final = "voxelposenet"
_BATCH = 16


@dataclass(frozen=True)
class _Words:
    """What the card of one kind of network says."""

    what: str
    where: str
    scored: str
    limits: str


_DEFAULT = _Words(
    """\
Estimates the 18 COCO joints of one person, hidden ones too, from the depth around the person and 2D keypoints; for
every joint a mean, a spread, the radius that holds 68 % of errors, and the probability of being within 10 cm.""",
    "`understudy.voxels.PersonView` and `understudy.voxelposenet.net`",
    """\
Of the network alone (no assembly), on simulated people in scenes that neither training nor calibration saw, with the
sensors above; training saw other bodies, calibration other people with these bodies.""",
    """\
Where no
depth is near the person, the distance comes from the apparent size and, if it is seen, the floor, and is off by 6 to
13 %, sometimes by half. Wrists and ankles are the least sure; hidden ones are guesses, and their sigma says so.""",
)
_PAPER = _Words(
    """\
The network of Zimmermann et al. (ICRA 2018), trained on simulation: of one person, a score volume for each of the 18
COCO joints from occupied voxels and 2D keypoints. It has no calibrated uncertainty.""",
    "`understudy.voxelposenet.paper_grid` and `understudy.voxelposenet.paper_net`; "
    "`understudy.voxelposenet.paper_lifter.PaperLifter` runs it",
    """\
The run's last validation, with the paper's assembly, on other bodies and scenes than those of training; people without
a root, whom the paper drops, count with what the network makes of a box around where they are.""",
    """\
Who has neither neck nor hip with depth is dropped, as in the paper.""",
)


def publish(run: Path, out: Path, samples: int = 1536, progress: bool = False) -> list[Path]:
    """Writes voxelposenet.safetensors, voxelposenet.onnx and a model card; of the paper's network no .onnx.

    run: folder of `Trainer`. The weights are the averaged ones of the run's last save, in half precision (which moves
    joints by 0.1 mm). Sigma and confidence are calibrated on `samples` simulated people whom neither
    training nor validation saw, and the card's scores are of as many others. progress: a bar on stderr.
    """
    run, out = Path(run), Path(out)
    if not (run / CONFIG).is_file() or not (run / WEIGHTS).is_file():
        raise UnderstudyError(f"{run}: not a training run: it lacks {CONFIG} or {WEIGHTS}")
    config, about = read_config(run / CONFIG), read_json(run / CONFIG)
    name = _NAME if config.network == "default" else f"{_NAME}-{config.network}"
    made = [out / f"{name}.safetensors"]
    scores: dict[str, float] = {}
    if config.network == "default":
        net = load_net(run / WEIGHTS)  # also makes sure that the file is whole
        scores = _calibrated(net, config, samples, progress)
        made.append(out / f"{name}.onnx")
        state = {k: v.half() if v.is_floating_point() else v for k, v in net.state_dict().items()}
        save_weights(made[0], state, config.net, {"run": json.dumps(about.get("config", {}))})
        export_onnx(load_net(made[0]), made[1])
        parameters = sum(p.numel() for p in net.parameters())
    else:
        parameters = sum(p.numel() for p in load_paper_net(run / WEIGHTS).parameters())
        write_atomically(made[0], (run / WEIGHTS).read_bytes())
    sizes = {path.name: path.stat().st_size / 1e6 for path in made}
    last = records.read(run / records.VALIDATION)[-1:] or [{}]
    write_atomically(out / CARD, _card(config, about, last[0], scores, parameters, sizes))
    return [*made, out / CARD]


def _calibrated(net: VoxelPoseNet, config: TrainConfig, samples: int, progress: bool) -> dict[str, float]:
    """Calibrates the network in place on one half of fresh people; its scores on the other half."""
    bodies = replace(
        config.data, bodies_seed=config.data.bodies_seed + 2000, anny=min(60, config.data.anny),
        capsules=min(40, config.data.capsules),
    )  # fmt: skip
    count = max(1, samples // _BATCH)
    halves = [Batches(bodies, _BATCH, config.validation_seed + k, count) for k in (1, 2)]
    first = collect(net, _bar(halves[0], "calibrating", progress))
    seen = first.in_view
    apply(net, fit(first.error[seen], first.sigma[seen], first.confidence[seen]))
    return summary(collect(net, _bar(halves[1], "scoring", progress)))


def _bar(batches: Batches, what: str, show: bool) -> Iterator[Batch]:
    from tqdm import tqdm

    yield from tqdm(batches, total=len(batches), desc=what, disable=not show)


def _card(
    config: TrainConfig,
    about: dict[str, Any],
    last: dict[str, str],
    scores: dict[str, float],
    parameters: int,
    sizes: dict[str, float],
) -> str:
    data = config.data
    rows = "\n".join(f"| {k} | {v} |" for k, v in (scores or last).items() if k not in ("step", "hours"))
    files = ", ".join(f"`{name}` ({size:.1f} MB)" for name, size in sizes.items())
    bodies = {"anny": f"{data.anny} of anny", "capsules": f"{data.capsules} of capsules"}
    chosen = " and ".join(v for k, v in bodies.items() if data.bodies in (k, "both"))
    machine = f"{about.get('machine', 'unknown')}, {config.device}, {about.get('processes', 1)} process(es)"
    words = _DEFAULT if config.network == "default" else _PAPER
    return f"""# {_NAME}: network `{config.network}`

{words.what}

- Files: {files}; {parameters:,} parameters.
- Input and output: {words.where}.
- Licence: MIT, as the code. No recorded person is in the training data.

## Training

- Command: `{shlex.join(map(str, about.get("command", [])))}`
- Began with: {config.init or "random weights"}.
- Machine: {machine}; torch {about.get("torch", "unknown")}.
- Steps: {last.get("step", "unknown")} of {config.batch} people per process; hours: {last.get("hours", "unknown")}.
- Seeds: weights and data {config.seed}, bodies {data.bodies_seed}, validation {config.validation_seed}.
- Data: simulated; bodies: {chosen}; sensors: {", ".join(data.samples.sensors)}; poses: {data.bvh or "sampled"}.

## Scores

{words.scored}
The scenes are hard: nearly half of the joints are hidden. Errors are means in cm over joints in view.

| number | value |
|---|---|
{rows}

## Limits

Trained on simulation only: adults of 15 to 80 years, 1 to 6 m from the camera, upright cameras between 0.4 and 2.4 m
above the floor. Not for children, animals, wheelchairs, or cameras that look straight down. {words.limits}

## Configuration

```json
{json.dumps(about.get("config", {}), indent=1)}
```
"""
