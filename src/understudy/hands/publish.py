"""From a run's folder to what is shipped: weights, the file for the light runtime, a model card (torch, onnx)."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any, Final

import torch
import torch.nn.functional as F
from safetensors.torch import save

from understudy.errors import UnderstudyError
from understudy.files import read_json, write_atomically
from understudy.hands.export import export_onnx
from understudy.hands.net import WITHIN, HandNormalNet
from understudy.hands.pool import HandPool
from understudy.hands.training import CONFIG, WEIGHTS, HandTrainer, predict, read_net, scores
from understudy.synthetic.hand_samples import HandBatch
from understudy.voxelposenet import records

CARD: Final = "MODEL_CARD.md"
_NAME: Final = "handnormalnet"


def publish(run: Path, out: Path, progress: bool = False) -> list[Path]:
    """Writes handnormalnet.safetensors, handnormalnet.onnx and a model card.

    run: folder of `HandTrainer`. The confidence is calibrated on one half of the run's validation hands, and the card's
    scores are of the other half.
    """
    run, out = Path(run), Path(out)
    if not (run / CONFIG).is_file() or not (run / WEIGHTS).is_file():
        raise UnderstudyError(f"{run}: not a training run: it lacks {CONFIG} or {WEIGHTS}")
    about = read_json(run / CONFIG)
    trainer = HandTrainer.reading(run)
    pool = trainer.pools()[1]
    pool.fill(
        trainer.config.workers, lambda done: print(f"simulated hands: {done} of {pool.shards}") if progress else 0
    )
    net = read_net(run / WEIGHTS).eval()
    first, second = _halves(pool)
    calibrate(net, first)
    state = {k: v.half() if v.is_floating_point() else v for k, v in net.state_dict().items()}
    made = [out / f"{_NAME}.safetensors", out / f"{_NAME}.onnx"]
    write_atomically(made[0], save(state, {"run": json.dumps(about["config"])}))
    shipped = read_net(made[0]).eval()
    export_onnx(shipped, made[1])
    last = records.read(run / records.VALIDATION)[-1:] or [{}]
    sizes = {path.name: path.stat().st_size / 1e6 for path in made}
    parameters = sum(p.numel() for p in net.parameters())
    write_atomically(out / CARD, _card(about, last[0], scores(shipped, second), parameters, sizes))
    return [*made, out / CARD]


def _halves(pool: HandPool) -> tuple[HandBatch, HandBatch]:
    hands = pool.load()
    first = torch.arange(len(hands.depth)) < len(hands.depth) // 2
    return HandBatch(*(t[first] for t in hands)), HandBatch(*(t[~first] for t in hands))


def calibrate(net: HandNormalNet, hands: HandBatch) -> None:
    """Scales and shifts the logit of the confidence, in place, so that it fits these hands best."""
    hands = HandBatch(*(t[hands.in_view] for t in hands))
    said = predict(net, hands)
    right = ((said.normal * hands.normal).sum(1) > WITHIN).float()
    scale, shift = torch.ones(1, requires_grad=True), torch.zeros(1, requires_grad=True)
    optimizer = torch.optim.LBFGS([scale, shift], max_iter=50)

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = F.binary_cross_entropy_with_logits(said.sure * scale + shift, right)
        loss.backward()
        return loss

    optimizer.step(closure)
    last = net.judge[-1]
    assert isinstance(last, torch.nn.Linear)
    with torch.no_grad():
        last.weight *= scale
        last.bias.mul_(scale).add_(shift)


def _card(
    about: dict[str, Any], last: dict[str, str], found: dict[str, float], parameters: int, sizes: dict[str, float]
) -> str:
    config = about["config"]
    files = ", ".join(f"`{name}` ({size:.1f} MB)" for name, size in sizes.items())
    rows = "\n".join(f"| {k} | {v} |" for k, v in found.items())
    data = config["data"]
    return f"""# {_NAME}

Says which way a palm faces (and where its fingers point, and 21 keypoints) from depth and colour around the hand, the
joints of the arm and the body, and, where it is asked, what another colour hand network says; with the probability
that the normal is within 30 degrees.

- Files: {files}; {parameters:,} parameters.
- Input and output: `understudy.hands.crop.HandView`, `understudy.hands.net`.
- Licence: MIT, as the code. No recorded person is in the training data.

## Training

- Command: `{shlex.join(map(str, about.get("command", [])))}`
- Steps: {last.get("step", "unknown")} of {config["batch"]} hands; hours: {last.get("hours", "unknown")}; torch \
{about.get("torch", "unknown")}; CPU.
- Data: {config["shards"]} x 512 simulated hands ({data["bodies"]} bodies and {data["hands"]} hands of anny, sensors \
{", ".join(data["samples"]["sensors"])}), {config["epochs"]} epochs. Colour crops are rendered with random colours
  and light (`understudy.synthetic.hand_images`); what the other network would say is drawn from a model of its errors
  (`understudy.synthetic.hand_color`).

## Scores

Degrees over simulated hands in view of other people, other hands, other scenes. *visible*: more than half of the near
side of the hand is seen by the depth camera; *hidden*: less than a fifth; *gripping*: visible and holding something.

| number | value |
|---|---|
{rows}

## Limits

Trained on simulation only: adults, bare hands, 0.6 to 6 m from the camera. From the depth alone a flat hand's palm and
back look alike beyond about 2 m; then the arm's posture and the colour decide. A hidden hand's normal is a guess from
the posture, and the confidence says so.

## Configuration

```json
{json.dumps(config, indent=1)}
```
"""
