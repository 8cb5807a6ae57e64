"""Banks of bodies as surface points, and posing them: forward kinematics with linear blend skinning.

Frame and segments are those of `segments.py`. A bank's bodies stand in a *rest* posture of its own (arms half lowered);
`align` leads from there to the canonical posture, and a pose is given as rotations from the canonical posture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from safetensors.torch import load, save
from torch import Tensor

from understudy.assets import cache_dir
from understudy.errors import UnderstudyError, one_of
from understudy.files import write_atomically
from understudy.skeleton import JOINT
from understudy.synthetic.segments import JOINT_SEGMENT, PARENTS, SEGMENT, SEGMENTS

REGIONS: Final = (
    "head_skin", "scalp", "neck", "trunk_upper", "trunk_lower", "upper_arm", "forearm", "hand", "thigh", "shin", "foot",
)  # fmt: skip
"""Parts of the surface; both sides of the body have the same code."""

REGION: Final = MappingProxyType({name: i for i, name in enumerate(REGIONS)})
"""Name -> code in `BodyBank.region`."""

VERSION: Final = 5
"""of the cached banks; to be raised whenever the same seed gives other bodies"""

_FACE_ROWS = [JOINT[n] for n in ("nose", "right_eye", "left_eye", "right_ear", "left_ear")]
_SHOULDERS = [JOINT["right_shoulder"], JOINT["left_shoulder"]]


def _ancestors() -> Tensor:
    """(S, S): 1 where the column is the row's segment itself or one of its ancestors."""
    chain = torch.eye(len(SEGMENTS))
    for i, parent in enumerate(PARENTS):
        if parent >= 0:
            chain[i] += chain[parent]
    return chain


_CHAIN: Final = _ancestors()
_PARENT: Final = [max(p, 0) for p in PARENTS]

_TWIST_SHARES: Final = (0.45, 0.9)
"""How much of a twist the helper segments take over; see `_helpers`."""


@dataclass(frozen=True)
class BodyBank:
    """N bodies with the same P surface points, at rest, in the body frame with the pelvis origin (0, 0, 0)."""

    points: Float[Tensor, "n p 3"]
    """surface points, metres"""
    normals: Float[Tensor, "n p 3"]
    """unit, outward"""
    weights: Float[Tensor, "p s"]
    """skinning weights over SEGMENTS; rows sum to 1"""
    origins: Float[Tensor, "n s 3"]
    """rotation centres of the segments"""
    align: Float[Tensor, "n s 3 3"]
    """rotations from the rest to the canonical orientation"""
    joints: Float[Tensor, "n 18 3"]
    """COCO-18 joints"""
    region: Int[Tensor, " p"]
    """codes, see REGION"""
    along: Float[Tensor, " p"]
    """0..1 along the region: limbs from the trunk outward, hand wrist to finger tips, foot heel to toes; trunk_lower
    from the crotch to the chest's origin, trunk_upper on to the neck's origin; neck upward, head from chin to crown"""
    drape: Float[Tensor, "n p"]
    """trunk: how far along the normal cloth lies that is taut around the trunk at that height, metres; elsewhere 0"""
    stature: Float[Tensor, " n"]
    """metres, barefoot"""
    female: Bool[Tensor, " n"]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.points.device

    @cached_property
    def segment(self) -> Int[Tensor, " p"]:
        """Each point's main segment."""
        return self.weights.argmax(1)

    @cached_property
    def helper_weights(self) -> Float[Tensor, "p v"]:
        """Weights over SEGMENTS and the helper segments of `_helpers`, which spread twists along arm and forearm."""
        weights = self.weights.clone()
        extra = []
        for part, share in (("upper_arm", 1 - self._share("upper_arm")), ("forearm", self._share("forearm"))):
            knots = torch.tensor((0.0, *_TWIST_SHARES), device=self.device)
            left = torch.bucketize(share.clamp(0, knots[-1].item()), knots[1:-1], right=True)
            mix = ((share - knots[left]) / (knots[left + 1] - knots[left])).clamp(0, 1)
            hats = torch.zeros(len(share), len(knots), device=self.device)
            hats.scatter_(1, left[:, None], (1 - mix)[:, None])
            hats.scatter_(1, left[:, None] + 1, mix[:, None])
            for side in ("right", "left"):
                column = SEGMENT[f"{side}_{part}"]
                own = weights[:, column].clone()
                weights[:, column] = own * hats[:, 0]
                extra += [own * hats[:, k] for k in range(1, len(knots))]
        return torch.cat([weights, torch.stack(extra, 1)], 1)

    def _share(self, part: str) -> Tensor:
        """(P,) 0..1 along upper arm or forearm, also for the points beyond its ends."""
        beyond = {"upper_arm": ("forearm", "hand"), "forearm": ("hand",)}[part]
        past = torch.zeros_like(self.along)
        for name in beyond:
            past[self.region == REGION[name]] = 1.0
        return torch.where(self.region == REGION[part], self.along, past)

    def to(self, device: torch.device | str) -> BodyBank:
        """The same bank on another device."""
        return BodyBank(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def select(self, indices: Tensor | Sequence[int]) -> BodyBank:
        """A bank of some of the bodies."""
        rows = torch.as_tensor(indices, device=self.device)
        per_body = ("points", "normals", "origins", "align", "joints", "drape", "stature", "female")
        return BodyBank(
            **{
                f.name: getattr(self, f.name)[rows] if f.name in per_body else getattr(self, f.name)
                for f in fields(self)
            }
        )

    def save(self, path: Path) -> None:
        """Writes a safetensors file, whole or not at all."""
        write_atomically(path, save({f.name: getattr(self, f.name).cpu().contiguous() for f in fields(self)}))

    @staticmethod
    def load(path: Path) -> BodyBank:
        """Reads what `save` wrote. Raises UnderstudyError for any other file."""
        try:
            return BodyBank(**load(Path(path).read_bytes()))
        except Exception as e:  # safetensors has its own exceptions
            raise UnderstudyError(f"{path}: not a readable bank of bodies: {e}") from e


@dataclass(frozen=True)
class Posed:
    """B posed bodies; body frame, pelvis origin at (0, 0, 0), metres."""

    points: Float[Tensor, "b p 3"]
    normals: Float[Tensor, "b p 3"]
    joints: Float[Tensor, "b 18 3"]
    origins: Float[Tensor, "b s 3"]
    rotations: Float[Tensor, "b s 3 3"]
    """from the canonical posture, as given to `pose`"""


def pose(
    bank: BodyBank,
    ids: Int[Tensor, " b"],
    rotations: Float[Tensor, "b s 3 3"],
    points: Float[Tensor, "b p 3"] | None = None,
    normals: Float[Tensor, "b p 3"] | None = None,
    bridge: Float[Tensor, "b p"] | None = None,
) -> Posed:
    """Poses bodies of the bank.

    ids: which bodies. rotations: `R_body_segment` of each segment, canonical posture = identity.
    points, normals: at rest, default those of the bank (dressed ones come from `clothing.dress`).
    bridge: `Dressed.bridge`, which carries points of one leg towards the other leg (skirts and coats).
    """
    rest = bank.origins[ids]
    align = bank.align[ids]
    total = rotations @ align
    step = (total[:, _PARENT] @ (rest - rest[:, _PARENT])[..., None])[..., 0]
    origins = _CHAIN.to(rest) @ step
    joints = _joints(bank.joints[ids], rest, origins, total)

    turn = torch.cat([total, _helpers(rotations, align, total)], 1)
    main = [
        *range(len(SEGMENTS)),
        *(SEGMENT[f"{s}_{p}"] for p in ("upper_arm", "forearm") for s in _SIDES for _ in "ab"),
    ]
    shift = origins[:, main] - (turn @ rest[:, main, :, None])[..., 0]
    blended = bank.helper_weights @ torch.cat([turn.mT, shift[:, :, None]], 2).flatten(2)  # (B, P, 12): columns
    columns = blended.unflatten(2, (4, 3)).unbind(2)
    posed = _apply(columns, bank.points[ids] if points is None else points).add_(columns[3])
    direction = _apply(columns, bank.normals[ids] if normals is None else normals)
    direction = direction * direction.square().sum(2, keepdim=True).clamp_min_(1e-12).rsqrt_()
    if bridge is not None:
        posed = _bridged(bank, origins, posed, bridge)
    return Posed(posed, direction, joints, origins, rotations)


_SIDES: Final = ("right", "left")


def _apply(columns: Sequence[Tensor], vectors: Tensor) -> Tensor:
    """Matrices given by their columns, times vectors; all (B, P, 3)."""
    out = columns[0] * vectors[..., 0:1]
    out.addcmul_(columns[1], vectors[..., 1:2])
    return out.addcmul_(columns[2], vectors[..., 2:3])


def _joints(rest_joints: Tensor, rest: Tensor, origins: Tensor, total: Tensor) -> Tensor:
    """Joints carried by their segments; the neck is the midpoint of the shoulders."""
    carrier = list(JOINT_SEGMENT)
    joints = origins[:, carrier].clone()
    head = SEGMENT["head"]
    face = rest_joints[:, _FACE_ROWS] - rest[:, None, head]
    joints[:, _FACE_ROWS] = origins[:, None, head] + face @ total[:, head].mT
    joints[:, JOINT["neck"]] = joints[:, _SHOULDERS].mean(1)
    return joints


def _helpers(rotations: Tensor, align: Tensor, total: Tensor) -> Tensor:
    """(B, 8, 3, 3): rotations from rest of helper segments that take a share of a twist, as (part, side, share).

    Helpers of the upper arm twist less than it (towards the clavicle), those of the forearm more (towards the hand).
    Without them a turned hand would wring the wrist to a thread.
    """
    out = []
    for part, reference in (("upper_arm", "clavicle"), ("forearm", "hand")):
        own = [SEGMENT[f"{s}_{part}"] for s in _SIDES]
        other = [SEGMENT[f"{s}_{reference}"] for s in _SIDES]
        relative = rotations[:, own].mT @ total[:, other] @ align[:, own].mT  # identity at rest
        angle = torch.atan2(relative[..., 2, 1] - relative[..., 1, 2], relative[..., 1, 1] + relative[..., 2, 2] + 1e-9)
        angle = angle[..., None] * torch.tensor(_TWIST_SHARES, device=angle.device)
        out.append(rotations[:, own, None] @ _about_x(angle) @ align[:, own, None])
    return torch.stack(out, 1).flatten(1, 3)


def _about_x(angle: Tensor) -> Tensor:
    """Rotation matrices about x."""
    c, s = angle.cos(), angle.sin()
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    return torch.stack([one, zero, zero, zero, c, -s, zero, s, c], -1).unflatten(-1, (3, 3))


def _bridged(bank: BodyBank, origins: Tensor, posed: Tensor, bridge: Tensor) -> Tensor:
    """Moves points of a leg by the share `bridge` of the way from this leg's axis to the other one's."""
    wearers = (bridge != 0).any(1).nonzero()[:, 0]
    if not len(wearers):
        return posed
    picked = ((bank.region == REGION["thigh"]) | (bank.region == REGION["shin"])).nonzero()[:, 0]
    names = [[SEGMENT[f"{s}_{p}"] for p in ("thigh", "shin", "foot")] for s in _SIDES]
    chain = origins[wearers][:, names]  # (W, 2, 3, 3)
    lower = (bank.region[picked] == REGION["shin"]).long()
    left = (bank.weights[picked][:, names[1]].sum(1) > 0.5).long()
    t = bank.along[picked, None]
    own = torch.lerp(chain[:, left, lower], chain[:, left, lower + 1], t)
    other = torch.lerp(chain[:, 1 - left, lower], chain[:, 1 - left, lower + 1], t)
    out = posed.clone()
    rows = wearers[:, None]
    out[rows, picked] = posed[rows, picked] + bridge[rows, picked, None] * (other - own)
    return out


def pose_extra(
    bank: BodyBank,
    ids: Int[Tensor, " b"],
    posed: Posed,
    extra: Float[Tensor, "b e 3"],
    extra_segment: Int[Tensor, "b e"],
    directions: bool = False,
) -> Float[Tensor, "b e 3"]:
    """Carries rest-frame points that are rigid to one segment each; absent points (NaN) stay NaN.

    directions: turn the vectors only (for normals).
    """
    index = extra_segment[..., None].expand(-1, -1, 3)
    total = posed.rotations @ bank.align[ids]
    origins = torch.zeros_like(posed.origins) if directions else posed.origins
    rest = torch.zeros_like(posed.origins) if directions else bank.origins[ids]
    matrix = total.flatten(2).gather(1, extra_segment[..., None].expand(-1, -1, 9)).unflatten(2, (3, 3))
    local = extra - rest.gather(1, index)
    return _apply(matrix.unbind(3), local) + origins.gather(1, index)


def load_bank(kind: str, n: int, seed: int, cache: Path | None = None) -> BodyBank:
    """A bank from the cache, built when it is not there yet.

    kind: `anny` (needs the package of that name to build) or `capsules`. cache: folder, default
    `understudy.assets.cache_dir()/synthetic`.
    """
    kinds = ("anny", "capsules")
    if kind not in kinds:
        raise UnderstudyError(f"kind of bodies {kind!r}: must be {one_of(kinds)}")
    path = (cache or cache_dir() / "synthetic") / f"bodies-{kind}-n{n}-seed{seed}-v{VERSION}.safetensors"
    if path.exists():
        return BodyBank.load(path)
    bank = anny_bank(n, seed) if kind == "anny" else capsule_bank(n, seed)
    bank.save(path)
    return bank


def anny_bank(n: int, seed: int, points: int = 9000) -> BodyBank:
    """n adults of the parametric body model anny; see `body_anny.build`."""
    from understudy.synthetic.body_anny import build

    return build(n, seed, points)


def capsule_bank(n: int, seed: int, points: int = 9000) -> BodyBank:
    """n adults of tapered tubes and boxes with the proportions of ANSUR II; see `body_capsules.build`."""
    from understudy.synthetic.body_capsules import build

    return build(n, seed, points)
