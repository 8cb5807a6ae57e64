"""From a run's folder to what is shipped: weights, the file for the light runtime, a model card (torch, onnx)."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any, Final

from understudy.errors import UnderstudyError
from understudy.files import read_json, write_atomically
from understudy.voxelposenet import records
from understudy.voxelposenet.checkpoint import load_net
from understudy.voxelposenet.export import export_onnx
from understudy.voxelposenet.paper_net import load_paper_net
from understudy.voxelposenet.train_config import TrainConfig
from understudy.voxelposenet.training import CONFIG, WEIGHTS, read_config

CARD: Final = "MODEL_CARD.md"
_NAME: Final = "voxelposenet"


def publish(run: Path, out: Path) -> list[Path]:
    """Writes voxelposenet.safetensors, voxelposenet.onnx and a model card; of the paper's network no .onnx.

    run: folder of `Trainer`. The weights are the averaged ones of the run's last save.
    """
    run, out = Path(run), Path(out)
    if not (run / CONFIG).is_file() or not (run / WEIGHTS).is_file():
        raise UnderstudyError(f"{run}: not a training run: it lacks {CONFIG} or {WEIGHTS}")
    config, about = read_config(run / CONFIG), read_json(run / CONFIG)
    name = _NAME if config.network == "default" else f"{_NAME}-{config.network}"
    made = [out / f"{name}.safetensors"]
    if config.network == "default":
        net = load_net(run / WEIGHTS)  # also makes sure that the file is whole
        made.append(out / f"{name}.onnx")
        export_onnx(net, made[1])
        parameters = sum(p.numel() for p in net.parameters())
    else:
        parameters = sum(p.numel() for p in load_paper_net(run / WEIGHTS).parameters())
    write_atomically(made[0], (run / WEIGHTS).read_bytes())
    sizes = {path.name: path.stat().st_size / 1e6 for path in made}
    write_atomically(out / CARD, _card(config, about, records.read(run / records.VALIDATION), parameters, sizes))
    return [*made, out / CARD]


def _card(
    config: TrainConfig,
    about: dict[str, Any],
    validations: list[dict[str, str]],
    parameters: int,
    sizes: dict[str, float],
) -> str:
    data = config.data
    last = validations[-1] if validations else {}
    scores = "\n".join(f"| {k} | {v} |" for k, v in last.items() if k not in ("step", "hours"))
    files = ", ".join(f"`{name}` ({size:.1f} MB)" for name, size in sizes.items())
    bodies = {"anny": f"{data.anny} of anny", "capsules": f"{data.capsules} of capsules"}
    chosen = " and ".join(v for k, v in bodies.items() if data.bodies in (k, "both"))
    machine = f"{about.get('machine', 'unknown')}, {config.device}, {about.get('processes', 1)} process(es)"
    return f"""# {_NAME}: network `{config.network}`

TODO: one paragraph: what it is for, and since which version of Understudy it is the default.

- Files: {files}; {parameters:,} parameters.
- Input and output: see `understudy.voxels.PersonView` and `understudy.voxelposenet.net`.
- Licence: TODO.

## Training

- Command: `{shlex.join(map(str, about.get("command", [])))}`
- Machine: {machine}; torch {about.get("torch", "unknown")}.
- Steps: {last.get("step", "unknown")} of {config.batch} people per process; hours: {last.get("hours", "unknown")}.
- Seeds: weights and data {config.seed}, bodies {data.bodies_seed}, validation {config.validation_seed}.
- Data: simulated; bodies: {chosen}; sensors: {", ".join(data.samples.sensors)}; poses: {data.bvh or "sampled"}.

## Scores

The last validation of the run: {config.validation_samples} simulated people, other bodies and scenes than in training,
every sensor. Errors are means in cm over joints in view.

| number | value |
|---|---|
{scores}

TODO: scores on real recordings and on held-out simulation (`understudy benchmark`).

## Limits

TODO: what it was not trained for, and where it is known to fail.

## Configuration

```json
{json.dumps(about.get("config", {}), indent=1)}
```
"""
