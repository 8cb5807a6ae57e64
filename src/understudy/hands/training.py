"""Training of HandNormalNet: simulated hands, many epochs of them, each time seen a little differently (torch).

OUT/config.json              the effective configuration, versions, command
OUT/hands/train, OUT/hands/validation
                             the simulated hands (`pool`); may be deleted after training
OUT/log.csv, validation.csv  what happened
OUT/checkpoint.safetensors   a run that is started again goes on from here
OUT/weights.safetensors      the moving average of the weights
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Bool, Float, UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from understudy.errors import ModelFileError, UnderstudyError, one_of
from understudy.files import read_json, write_atomically
from understudy.hands.crop import CELL, CELLS, EMPTY, GREY, LIMIT, UNSURE
from understudy.hands.net import HandNormalNet, HandOutput, loss
from understudy.hands.pool import SHARD, HandPool, PoolConfig
from understudy.synthetic.draw import Draw
from understudy.synthetic.hand_color import color_words
from understudy.synthetic.hand_samples import HandBatch
from understudy.voxelposenet import records
from understudy.voxelposenet.checkpoint import load_checkpoint, save_checkpoint
from understudy.voxelposenet.optimizers import OPTIMIZERS, Optimizers
from understudy.voxelposenet.processes import Stop
from understudy.voxelposenet.train_config import filled

KIND: Final = "hands"
"""What config.json calls such a run."""
CONFIG, CHECKPOINT, WEIGHTS, HANDS = "config.json", "checkpoint.safetensors", "weights.safetensors", "hands"
FREE: Final = ("workers", "validate_every", "checkpoint_every", "log_every")
"""Fields that may change when a run goes on."""

_READERS = ("votes.1", "read", "judge")
_SHIFT = 4  # cells, even: how far crops are moved
_PIXELS_IN_TWO_CELLS = 3  # pixels of the colour crop in two cells of the depth crop
_COLORLESS, _DULL = 0.2, 0.08  # share of hands without a colour crop, and with a grey one
_DEPTH_SHIFT = 0.02  # metres, one sigma
_COLOR_PIXELS = 1.5  # pixels of the colour image for one of the depth image
_BLIND = 0.10  # share of hands without any depth
_CUT, _CUT_FROM = 0.12, 0.1  # share of hands whose depth ends at a line, and how far from the middle at most (metres)
_UNKNOWN, _UNKNOWN_JOINTS = 0.1, 0.5  # share of hands of whose bodies joints are not known, and of these joints
_VALIDATION_BATCH = 512


@dataclass(frozen=True)
class HandTrainConfig:
    """Everything that decides the weights."""

    data: PoolConfig = field(default_factory=PoolConfig)
    shards: int = 260
    """of 512 simulated hands"""
    epochs: int = 10
    batch: int = 256
    optimizer: str = "adamw"
    """one of `optimizers.OPTIMIZERS`; Muon takes a third of a step of this small network"""
    learning_rate: float = 2e-3
    warmup: int = 200
    weight_decay: float = 0.05
    ema: float = 0.998
    init: str | None = None
    """file of weights to begin with in place of random ones: a run's, or the shipped ones"""
    seed: int = 0
    validation_shards: int = 8
    validation_seed: int = 900
    validate_every: int = 500
    checkpoint_every: int = 250
    log_every: int = 25
    bf16: bool = True
    """bfloat16 autocast: twice as fast where the processor has it"""
    workers: int = 2
    """processes that simulate"""

    def __post_init__(self) -> None:
        if self.optimizer not in OPTIMIZERS:
            raise UnderstudyError(f"optimizer {self.optimizer!r}: must be {one_of(OPTIMIZERS)}")
        for name in (
            "shards",
            "epochs",
            "batch",
            "validation_shards",
            "validate_every",
            "checkpoint_every",
            "log_every",
        ):
            if getattr(self, name) < 1:
                raise UnderstudyError(f"{name} {getattr(self, name)}: must be at least 1")

    def rate(self, step: int, steps: int) -> float:
        """The learning rate of a step: linear warm-up, then a cosine down to a hundredth."""
        if step < self.warmup:
            return self.learning_rate * (step + 1) / self.warmup
        done = (step - self.warmup) / max(1, steps - self.warmup)
        return self.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, done))))

    def validation(self) -> PoolConfig:
        """Other people, hands and scenes."""
        data = self.data
        return replace(
            data, bank_seed=data.bank_seed + 1000, bodies=min(60, data.bodies), hands=min(40, data.hands),
            seed=self.validation_seed,
        )  # fmt: skip


class HandTrainer:
    """One training run; an interruption loses nothing."""

    def __init__(self, config: HandTrainConfig, out: Path, record: bool = True):
        """out: folder of the run. record: make it, or go on in it; otherwise it is only read."""
        self.config, self.out = config, Path(out)
        torch.manual_seed(config.seed)
        begins = record and not (self.out / CHECKPOINT).exists()
        self.net = read_net(Path(config.init)) if config.init and begins else HandNormalNet()
        self.net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # a fifth faster on a CPU
        self.optimizers = Optimizers(self.net, config.optimizer, config.learning_rate, config.weight_decay, _READERS)
        self.average = {k: v.detach().clone() for k, v in self.net.state_dict().items()}
        self.step, self.seconds = 0, 0.0
        if record:
            self._prepare()

    @property
    def steps(self) -> int:
        """Of the whole run."""
        return self.config.epochs * (self.config.shards * SHARD // self.config.batch)

    @classmethod
    def reading(cls, run: Path) -> HandTrainer:
        """The trainer of a run that is there."""
        config = filled(read_json(run / CONFIG)["config"], HandTrainConfig(), str(run / CONFIG))
        return cls(config, run, record=False)

    def _prepare(self) -> None:
        path = self.out / CONFIG
        now = json.loads(json.dumps(asdict(self.config)))
        if path.exists():
            before = read_json(path)
            if before.get("kind") != KIND:
                raise UnderstudyError(f"{path}: the run there is of another network; choose another folder")
            for name, value in now.items():
                if name not in FREE and before["config"].get(name) != value:
                    raise UnderstudyError(
                        f"{path}: the run there has another {name} ({before['config'].get(name)!r}, now {value!r}); "
                        "choose another folder, or delete that one"
                    )
        if (self.out / CHECKPOINT).exists():
            self.step, self.seconds = load_checkpoint(
                self.out / CHECKPOINT, self.net, self.average, self.optimizers.each
            )
        for name in (records.LOG, records.VALIDATION):
            records.keep_until(self.out / name, self.step)
        about = {"kind": KIND, "config": now, "command": sys.argv, "torch": torch.__version__}
        self.out.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(about, indent=1) + "\n")

    def pools(self) -> tuple[HandPool, HandPool]:
        """The stores for training and validation."""
        folder, config = self.out / HANDS, self.config
        return (
            HandPool(folder / "train", config.data, config.shards),
            HandPool(folder / "validation", config.validation(), config.validation_shards),
        )

    def run(
        self,
        report: Callable[[dict[str, Any]], object] = lambda row: None,
        progress: Callable[[int], object] = lambda step: None,
    ) -> HandNormalNet:
        """Trains to the end (the pools must be filled). Returns the network with the averaged weights.

        report: gets each line of the log and of the validations. progress: gets the number of steps done.
        Raises KeyboardInterrupt after it has saved when Ctrl-C or SIGTERM asks to stop.
        """
        train, validation = (pool.load() for pool in self.pools())
        usable = train.in_view.nonzero()[:, 0]
        start, seconds = time.monotonic(), self.seconds
        sums: dict[str, float] = {}
        since = 0
        with Stop() as stop, ThreadPoolExecutor(1) as beside:
            made = beside.submit(self._made, self.step, train, usable) if self.step < self.steps else None
            while made is not None:
                batch = made.result()
                more = self.step + 1 < self.steps
                made = beside.submit(self._made, self.step + 1, train, usable) if more else None  # during this step
                parts = self._learn(*batch)
                self.step += 1
                since += 1
                self.seconds = seconds + time.monotonic() - start
                sums = {k: sums.get(k, 0.0) + float(v) for k, v in parts.items()}
                progress(self.step)
                last = self.step == self.steps
                if self.step % self.config.log_every == 0 or last:
                    row = {"step": self.step, "hours": round(self.seconds / 3600, 4)}
                    row |= {k: round(v / since, 4) for k, v in sums.items()}
                    if not math.isfinite(row["loss"]):
                        raise UnderstudyError(f"step {self.step}: the loss is {row['loss']}")
                    records.append(self.out / records.LOG, [row])
                    report(row)
                    sums, since = {}, 0
                if self.step % self.config.checkpoint_every == 0 or last or stop.asked:
                    self._save()
                if stop.asked:
                    raise KeyboardInterrupt
                if self.step % self.config.validate_every == 0 or last:
                    row = {
                        "step": self.step,
                        "hours": round(self.seconds / 3600, 4),
                        **scores(self.averaged(), validation),
                    }
                    records.append(self.out / records.VALIDATION, [row])
                    report(row)
        return self.averaged()

    def _made(self, step: int, pool: HandBatch, usable: Tensor) -> tuple[HandBatch, tuple[Tensor, ...]]:
        """The hands of a step, and what the network is given of them."""
        draw = Draw(self.config.seed * 7919 + step)
        batch = varied(draw, self._drawn(step, pool, usable))
        return batch, inputs(batch, colored(draw, batch))

    def _drawn(self, step: int, pool: HandBatch, usable: Tensor) -> HandBatch:
        """Epoch by epoch, each in an order of its own."""
        per_epoch = len(usable) // self.config.batch
        epoch, place = divmod(step, per_epoch)
        generator = torch.Generator().manual_seed(self.config.seed * 1009 + epoch)
        order = usable[torch.randperm(len(usable), generator=generator)]
        rows = order[place * self.config.batch : (place + 1) * self.config.batch]
        return HandBatch(*(t[rows] for t in pool))

    def _learn(self, batch: HandBatch, given: tuple[Tensor, ...]) -> dict[str, Tensor]:
        self.net.train()
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.bf16):
            said = self.net(*given)
        output = HandOutput(*(part.float() for part in said))
        total, parts = loss(output, batch.normal, batch.direction, batch.landmarks)
        self.optimizers.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 5.0)
        self.optimizers.step(self.config.rate(self.step, self.steps))
        keep = min(self.config.ema, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for k, v in self.net.state_dict().items():
                if v.is_floating_point():
                    self.average[k].lerp_(v, 1 - keep)
                else:
                    self.average[k].copy_(v)
        return {"loss": total.detach(), **{k: v.detach() for k, v in parts.items()}}

    def averaged(self) -> HandNormalNet:
        """A copy with the averaged weights, for use."""
        net = HandNormalNet()
        net.load_state_dict(self.average)
        return net.eval()

    def _save(self) -> None:
        save_checkpoint(self.out / CHECKPOINT, self.net, self.average, self.optimizers.each, self.step, self.seconds)
        write_atomically(self.out / WEIGHTS, save({k: v.contiguous() for k, v in self.average.items()}))


def read_net(path: Path) -> HandNormalNet:
    """The network with the weights of a file. Raises ModelFileError when they are not this network's."""
    net = HandNormalNet()
    try:
        net.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in load_file(path).items()})
    except (OSError, SafetensorError, RuntimeError) as e:
        raise ModelFileError(f"{path}: not readable weights of this network: {e}") from e
    return net


def varied(draw: Draw, batch: HandBatch) -> HandBatch:
    """The same hands, believed to be a little elsewhere, and measured a little worse."""
    b = len(batch.depth)
    depth = batch.depth.float()
    du, dv = (2 * draw.integers(_SHIFT + 1, b) - _SHIFT for _ in range(2))  # by whole pixels of both crops
    dz = _DEPTH_SHIFT * draw.normal(b)
    near = _rolled(depth[:, :1], du, dv, EMPTY)[:, 0]
    gone = draw.chance(draw.uniform(0, 0.4, b, 1, 1) * draw.chance(0.3, b, 1, 1), b, CELLS, CELLS)
    gone |= draw.chance(_BLIND, b, 1, 1) | _cut(draw, b)
    seen = (near < EMPTY) & ~gone & (near + dz[:, None, None] > -LIMIT)
    near = torch.where(seen, (near + dz[:, None, None]).clamp_max(LIMIT), EMPTY)
    shift = torch.stack([du * CELL, dv * CELL, dz], -1)[:, None]
    context = _some_unknown(draw, batch.context + shift + 0.006 * draw.normal(*batch.context.shape))
    return batch._replace(
        depth=torch.stack([near, seen.float()], 1), context=context, distance=batch.distance - dz[:, None],
        sigma=batch.sigma * draw.lognormal(0.15, *batch.sigma.shape),
        image=relit(draw, _rolled(batch.image, _PIXELS_IN_TWO_CELLS * du // 2, _PIXELS_IN_TWO_CELLS * dv // 2, GREY)),
        landmarks=batch.landmarks + shift,
    )  # fmt: skip


def _some_unknown(draw: Draw, context: Float[Tensor, "b 11 3"]) -> Float[Tensor, "b 11 3"]:
    """Of some bodies, joints but wrist and elbow put into the middle of those that are known, as `HandView.of` does."""
    b, n = context.shape[:2]
    known = ~(draw.chance(_UNKNOWN_JOINTS, b, n) & draw.chance(_UNKNOWN, b)[:, None])
    known[:, : len(UNSURE)] = True
    middle = (context * known[..., None]).sum(1, keepdim=True) / known.sum(1)[:, None, None]
    return torch.where(known[..., None], context, middle)


def _cut(draw: Draw, b: int) -> Bool[Tensor, "b s s"]:
    """Cells beyond a line through the crop: shadows of the projector, edges of the image, dark cloth."""
    step = (torch.arange(CELLS) + 0.5 - CELLS / 2) * CELL
    angle = draw.uniform(0, 2 * math.pi, b, 1, 1)
    beyond = angle.cos() * step + angle.sin() * step[:, None] > draw.uniform(-_CUT_FROM, _CUT_FROM, b, 1, 1)
    return beyond & draw.chance(_CUT, b, 1, 1)


def _rolled(image: Tensor, du: Tensor, dv: Tensor, fill: float) -> Tensor:
    """(B, C, S, S) moved by (du, dv) pixels; `fill` comes in at the sides."""
    b, c, size = image.shape[:3]
    most = 2 * _SHIFT
    wide = torch.nn.functional.pad(image, (most,) * 4, value=fill)
    at = torch.arange(size) + most
    rows, columns = (at - dv[:, None])[:, None, :, None], (at - du[:, None])[:, None, None]
    return wide[torch.arange(b)[:, None, None, None], torch.arange(c)[:, None, None], rows, columns]


def relit(draw: Draw, image: UInt8[Tensor, "b 3 s s"]) -> Float[Tensor, "b 3 s s"]:
    """In other light, by other cameras; of some the colours are gone, of some there is no image (GREY)."""
    b = len(image)
    x = image.float() / 255
    x = x ** draw.lognormal(0.2, b, 1, 1, 1) * draw.lognormal(0.25, b, 1, 1, 1) * draw.lognormal(0.08, b, 3, 1, 1)
    x = x + 0.04 * draw.normal(b, 1, 1, 1)
    dull = draw.chance(_DULL, b)[:, None, None, None]
    x = torch.where(dull, x.mean(1, keepdim=True), x) + draw.uniform(0, 0.03, b, 1, 1, 1) * draw.normal(*x.shape)
    none = draw.chance(_COLORLESS, b)[:, None, None, None]
    return torch.where(none, float(GREY), 255 * x.clamp(0, 1))


def inputs(batch: HandBatch, color: Float[Tensor, "b 9"]) -> tuple[Tensor, ...]:
    """What the network is given of a batch, in its order."""
    return batch.depth.float(), batch.context, batch.distance, color, batch.sigma, batch.image.float()


def colored(draw: Draw, batch: HandBatch) -> Tensor:
    """What the colour path says of the hands."""
    pixels = batch.pixels * _COLOR_PIXELS * draw.lognormal(0.3, len(batch.pixels))
    return color_words(draw, batch.normal, batch.direction, batch.visible, pixels)


@torch.no_grad()
def predict(net: HandNormalNet, batch: HandBatch, seed: int = 0) -> HandOutput:
    """The network's word on hands as they are, with simulated colour words."""
    parts = []
    for start in range(0, len(batch.depth), _VALIDATION_BATCH):
        part = HandBatch(*(t[start : start + _VALIDATION_BATCH] for t in batch))
        color = colored(Draw(seed * 31 + start + 5), part)
        parts.append(net(*inputs(part, color)))
    return HandOutput(*(torch.cat(p) for p in zip(*parts, strict=True)))


def scores(net: HandNormalNet, hands: HandBatch) -> dict[str, float]:
    """Errors in degrees over the hands in view: of all, of visible, hidden and gripping ones; and the calibration."""
    hands = HandBatch(*(t[hands.in_view] for t in hands))
    output = predict(net, hands)
    error = torch.rad2deg(torch.acos((output.normal * hands.normal).sum(1).clamp(-1, 1)))
    sure = output.sure.sigmoid()
    bins = (sure * 10).long().clamp_max(9)
    gaps = [
        float((bins == k).float().mean() * (sure[bins == k].mean() - (error[bins == k] < 30).float().mean()).abs())
        for k in range(10)
        if (bins == k).any()
    ]
    visible, hidden = hands.visible > 0.5, hands.visible < 0.2
    groups = {"all": hands.in_view, "visible": visible, "hidden": hidden, "half": ~visible & ~hidden}
    groups["gripping"] = (hands.grip > 0) & visible
    out: dict[str, float] = {}
    for name, rows in groups.items():
        chosen = error[rows]
        out |= {f"{name}_mean": float(chosen.mean()), f"{name}_median": float(chosen.median())}
        out[f"{name}_flips"] = float((chosen > 90).float().mean())
    landmarks = (output.landmarks - hands.landmarks).norm(dim=2).mean(1)
    out |= {"landmarks_cm": float(100 * landmarks[groups["visible"]].mean()), "calibration": sum(gaps)}
    return {k: round(v, 4) for k, v in out.items()}
