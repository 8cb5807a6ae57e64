"""Palm normals of simulated hands in detail, by the exported network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.special import expit

from understudy.errors import MissingExtraError, UnderstudyError
from understudy.hands.crop import EMPTY, GREY
from understudy.hands.estimator import CONFIDENT, LEAST_CONFIDENCE
from understudy.hands.nets import WRIST
from understudy.hands.predictor import HandPrediction, pooled

if TYPE_CHECKING:
    import torch

from understudy.benchmark.palms import ALL_GIVEN, BOTH, DEPTH, POSTURE, WORD, Said, Source, TrueHands

BODIES, HANDS, BANK_SEED, SEED = 60, 40, 2001, 4242
"""The simulated hands: different bodies and hands, the seed of both banks, and that of everything else. Training has
bank seed 1 and other seeds, its validation 1001 and 900."""

_BATCH = 64  # simulated hands at a time
_ASKED = 512  # hands that the network is asked at a time


@dataclass(frozen=True, eq=False)
class SimulatedHands:
    """n simulated hands in view: truth, and the network's inputs."""

    hands: TrueHands
    depth: Float32[np.ndarray, "n 2 48 48"]
    context: Float32[np.ndarray, "n 11 3"]
    distance: Float32[np.ndarray, "n 1"]
    sigma: Float32[np.ndarray, "n 2"]
    image: UInt8[np.ndarray, "n 3 72 72"]
    color: Float32[np.ndarray, "n 9"]
    """simulated words of the colour path"""


def simulate(n: int, progress: bool = True) -> SimulatedHands:
    """The first n hands in view of people and scenes that neither training nor validation has. Needs torch and anny."""
    from tqdm import tqdm

    try:
        import torch

        from understudy.hands.training import colored
        from understudy.synthetic.bodies import load_bank
        from understudy.synthetic.draw import Draw
        from understudy.synthetic.hand_bank import load_hands
        from understudy.synthetic.hand_samples import HandBatch, HandSamples

        samples = HandSamples(load_bank("anny", BODIES, BANK_SEED), load_hands(HANDS, BANK_SEED), seed=SEED)
    except ImportError as e:
        if (e.name or "").partition(".")[0] == "understudy":
            raise
        raise MissingExtraError("simulated hands (--hands 0 goes without)", "train") from e
    parts: list[HandBatch] = []
    words: list[torch.Tensor] = []
    made = 0
    with tqdm(total=n, unit="hand", desc="simulated hands", disable=not progress) as bar:
        for number in count():
            if made >= n:
                break
            batch = samples.batch(number, _BATCH)
            color = colored(Draw(SEED * 31 + number), batch)
            parts.append(HandBatch(*(t[batch.in_view] for t in batch)))
            words.append(color[batch.in_view])
            made += len(words[-1])
            bar.update(min(made, n) - bar.n)
    arrays = {name: torch.cat([getattr(p, name) for p in parts])[:n].numpy() for name in HandBatch._fields}
    wrist = arrays["landmarks"][:, WRIST].astype(np.float64)
    wrist[:, 2] += arrays["distance"][:, 0]
    return SimulatedHands(
        _simulated_truth(wrist, arrays),
        arrays["depth"],
        arrays["context"],
        arrays["distance"],
        arrays["sigma"],
        arrays["image"],
        torch.cat(words)[:n].numpy(),
    )


def _simulated_truth(wrist: Float[np.ndarray, "n 3"], arrays: Mapping[str, np.ndarray]) -> TrueHands:
    """wrist: metres, in the crop view seen from the camera."""
    normal = arrays["normal"].astype(np.float64)
    distance = np.linalg.norm(wrist, axis=1)
    return TrueHands(
        recording=np.zeros(len(wrist), np.int64),
        normal=normal,
        distance_m=distance,
        pixels=arrays["pixels"].astype(np.float64),
        facing=np.einsum("ni,ni->n", normal, wrist) / distance,
        visible=arrays["visible"].astype(np.float64),
        grip=arrays["grip"].astype(np.int64),
    )


HandNetwork = Callable[..., Sequence[np.ndarray]]
"""Called as `HandPredictor.network` is."""


def from_simulation(simulated: SimulatedHands, network: HandNetwork) -> Source:
    """What the exported network says of simulated hands."""
    n = len(simulated.depth)
    if not n:
        raise UnderstudyError("simulated hands: there are none; at least 1 is needed")
    blind = np.zeros_like(simulated.depth)
    blind[:, 0] = EMPTY
    mute, grey = np.zeros_like(simulated.color), np.full_like(simulated.image, GREY)
    word, given = simulated.color.astype(np.float64), simulated.color[:, 8] > 0
    first = _ask(network, simulated, simulated.depth, mute, simulated.image)
    again = given & (first.confidence < CONFIDENT)
    every = _joined(first, _ask(network, simulated, simulated.depth, simulated.color, simulated.image), again)
    said = {
        BOTH: least_sure(every),
        ALL_GIVEN: every,
        DEPTH: least_sure(_ask(network, simulated, simulated.depth, mute, grey)),
        POSTURE: _ask(network, simulated, blind, mute, grey),
        WORD: Said(np.where(given[:, None], word[:, :3], np.nan), np.where(given, word[:, 7], np.nan)),
    }
    about = (
        f"{n} hands in view of simulated people, hands and scenes that neither training nor validation has seen "
        f"({BODIES} bodies, {HANDS} different hands), as they are put to the exported network: depth crops with a "
        "sensor's errors, colour crops, joints with an estimate's errors, and, where the first look is unsure, words "
        "of the colour path with its measured errors (drawn by a model, `synthetic.hand_color`). A second look is in "
        "the same place; the estimator also moves it to where it found the wrist. The colour network alone is compared "
        "on recordings only: here is no whole image for it to look at."
    )
    return Source("Simulated hands in detail", "simulated", (), True, simulated.hands, said, about, {})


def _joined(first: Said, second: Said, again: Bool[np.ndarray, " n"]) -> Said:
    """What the estimator makes of two looks at some of the hands."""
    normal, confidence = first.normal.copy(), first.confidence.copy()
    for i in np.flatnonzero(again):
        looks = [
            HandPrediction(said.normal[i], said.normal[i], np.zeros((21, 3)), float(said.confidence[i]))
            for said in (first, second)
        ]
        both = pooled(looks)
        normal[i], confidence[i] = both.normal, both.confidence
    return Said(normal, confidence)


def _ask(
    network: HandNetwork,
    hands: SimulatedHands,
    depth: Float32[np.ndarray, "n 2 48 48"],
    color: Float32[np.ndarray, "n 9"],
    image: UInt8[np.ndarray, "n 3 72 72"],
) -> Said:
    parts = []
    for start in range(0, len(depth), _ASKED):
        rows = slice(start, start + _ASKED)
        normal, _, _, sure = network(
            depth=depth[rows],
            context=hands.context[rows],
            distance=hands.distance[rows],
            color=color[rows],
            sigma=hands.sigma[rows],
            image=image[rows].astype(np.float32),
        )
        parts.append(Said(normal.astype(np.float64), expit(sure.astype(np.float64))))
    return Said.pooled(parts)


def least_sure(said: Said, least: float = LEAST_CONFIDENCE) -> Said:
    """Without the palms of a confidence below `least`."""
    given = said.confidence >= least
    return Said(np.where(given[:, None], said.normal, np.nan), np.where(given, said.confidence, np.nan))
