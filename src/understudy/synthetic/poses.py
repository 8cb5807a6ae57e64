"""Random human postures: who does what is drawn from `pose_activities`, and solved here for the whole batch at once.

A posture is a few dozen uniform numbers (`Draws`) scaled to the ranges of an activity: legs and trunk by angles or by
where the feet stand, hands by where the wrists are. Several candidates of the legs and of each arm are computed, and
the one that respects the joints' limits and stays clear of the rest of the body is kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from understudy.errors import UnderstudyError, one_of
from understudy.synthetic import kinematics as kin
from understudy.synthetic.kinematics import along, interpolate, rot, turn, unit, within_limits
from understudy.synthetic.pose_activities import ACTIVITIES, FRAMES, PELVIS_FIELDS
from understudy.synthetic.pose_limbs import Body, Legs, solve_arm, solve_legs
from understudy.synthetic.pose_tables import NAMES, TRIED, Draws, draw, tables_on

__all__ = ["ACTIVITIES", "NAMES", "PoseBatch", "interpolate", "sample_poses", "sequence", "within_limits"]

BAD_CLASH: Final = 0.08
"""Metres of overlap from which a posture is drawn again."""


@dataclass(frozen=True)
class PoseBatch:
    """Postures and what they are.

    Attributes:
        rotations: absolute rotation of each segment, `R_body_segment` (see `segments.py`); the pelvis faces about -y.
        activity: index into `NAMES`.
        clash: metres by which limbs are inside the body or each other (sum over the checked points); 0 = free.
    """

    rotations: Float[Tensor, "n 21 3 3"]
    activity: Int[Tensor, " n"]
    clash: Float[Tensor, " n"]

    @property
    def names(self) -> list[str]:
        """Each posture's activity in words."""
        return [NAMES[i] for i in self.activity.tolist()]


@dataclass(frozen=True)
class Solved:
    """Postures and which candidates were kept (to keep them along a sequence)."""

    rotations: Tensor  # [n, 21, 3, 3]
    clash: Tensor  # [n]
    legs: Tensor  # [n] ...
    right: Tensor
    left: Tensor


def _pick(cumulative: Tensor, u: Tensor) -> Tensor:
    return (u[:, None] >= cumulative).sum(1).clamp(max=cumulative.shape[1] - 1)


def solve(draws: Draws, keep: Solved | None = None) -> Solved:
    """From uniform numbers to postures; `keep` fixes which candidates are taken."""
    device = draws.trunk.device
    table = tables_on(str(device))
    activity, n = draws.activity, len(draws.activity)
    rows = torch.arange(n, device=device)
    pick_lower, pick_hands, pick_mirror, phase, pick_look, pick_lay = draws.choices.unbind(1)
    lower = _pick(table.lower_choice[activity], pick_lower)
    hand_a, hand_b, tied = table.hands[activity, _pick(table.hands_choice[activity], pick_hands)].unbind(-1)
    span = table.trunk[activity]
    fold, bend, lean, twist, nod, tip, head_turn, _ = (
        span[..., 0] + (span[..., 1] - span[..., 0]) * draws.trunk
    ).unbind(1)
    look = pick_look < span[:, -1, 0]

    tried = solve_legs(table, lower, draws, fold, phase)
    legs_kept = tried.cost.argmin(1) if keep is None else keep.legs
    legs = Legs(*(getattr(tried, f.name)[rows, legs_kept] for f in fields(Legs)))
    amp_span = table.pelvis[lower, PELVIS_FIELDS.index("amp")]
    amp = amp_span[:, 0] + (amp_span[:, 1] - amp_span[:, 0]) * draws.pelvis[rows, legs_kept, PELVIS_FIELDS.index("amp")]

    room = 1.9 - torch.asin(-legs.pelvis[:, 1, 2].clamp(-1, 1))  # nobody folds beyond the knees
    bend = torch.minimum(bend, room)
    abdomen = legs.pelvis @ rot(2, 0.4 * twist) @ rot(0, 0.45 * bend) @ rot(1, 0.45 * lean)
    chest = legs.pelvis @ rot(2, twist) @ rot(0, bend) @ rot(1, lean)
    chest_at = along(legs.pelvis, (0.0, 0.0, 0.10)) + along(abdomen, (0.0, 0.0, 0.16))
    neck_at = chest_at + along(chest, (0.0, 0.0, 0.26))
    stoop = torch.atan2(-chest[:, 1, 2], chest[:, 2, 2].clamp_min(0.2)).clamp(-0.3, 1.2)
    nod = nod - 0.45 * stoop
    neck, head = _head(chest, nod, tip, head_turn)
    head_at = neck_at + along(neck, (0.0, 0.0, 0.09))

    flip = torch.tensor([-1.0, 1.0, 1.0], device=device)
    both = flip[:, None] * flip
    side = torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]], device=device)
    hips = -kin.HIP_HALF * legs.pelvis[:, :, 0]
    hips = torch.stack((hips, -hips), 1)
    knees = hips - kin.THIGH * legs.thigh[..., 2] * side
    ankles = knees - kin.SHIN * legs.shin[..., 2] * side
    waist = [along(legs.pelvis, (x, 0.0, z)) for x in (-0.07, 0.07) for z in (-0.04, 0.08)]
    ribs = [chest_at + along(chest, (x, 0.0, z)) for x in (-0.08, 0.08) for z in (0.0, 0.2)]
    from_ = [waist[0], waist[2], waist[1], waist[3], ribs[0], ribs[2], head_at + along(head, (0.0, -0.02, 0.02))]
    to = [waist[1], waist[3], ribs[0], ribs[2], ribs[1], ribs[3], head_at + along(head, (0.0, -0.02, 0.13))]
    starts = torch.cat((torch.stack(from_, 1), hips, knees), 1)
    ends = torch.cat((torch.stack(to, 1), knees, ankles), 1)
    radii = torch.tensor([0.11, 0.11, 0.105, 0.105, 0.105, 0.105, 0.10, 0.075, 0.075, 0.05, 0.05], device=device)
    lies = table.pelvis[lower, PELVIS_FIELDS.index("lay"), 0] > 0.5
    quarter = torch.floor(pick_lay * 4) * (math.pi / 2)  # on the back, a side, the belly, the other side
    down = rot(0, torch.full_like(quarter, -math.pi / 2)) @ rot(2, quarter + 0.5 * (phase - 0.5))
    down = torch.where(lies[:, None, None], down, torch.eye(3, device=device))
    upward, under = down[:, 2], torch.where(lies, 0.16 + 0.05 * (quarter.sin() != 0), legs.height)
    body = Body(
        legs.pelvis,
        chest,
        head,
        chest_at,
        head_at,
        knees[:, 0],
        legs.thigh[:, 0],
        legs.height,
        upward,
        under,
        starts,
        ends,
        radii,
    )
    right = solve_arm(table, hand_a, draws.hands[:, 0], body, phase + 0.5, amp, None if keep is None else keep.right)
    clavicle_end = chest_at + along(chest, (-0.02, 0.0, 0.22)) + along(right.clavicle, (-kin.SHOULDER[0], 0.0, 0.0))
    other = replace(
        body,
        knee=knees[:, 1],
        thigh=legs.thigh[:, 1] * both,
        starts=torch.cat((starts, clavicle_end[:, None], right.elbow[:, None], right.wrist[:, None]), 1),
        ends=torch.cat(
            (ends, right.elbow[:, None], right.wrist[:, None], (right.wrist - 0.1 * right.hand[..., 0])[:, None]), 1
        ),
        radii=torch.cat((radii, torch.tensor([0.045, 0.035, 0.02], device=device))),
    ).mirrored()
    same = draws.hands[rows, 0, right.chosen][:, None].expand(-1, TRIED, -1)
    mine = draws.hands[:, 1]
    mixed = torch.cat((same[..., :3] + 0.15 * (mine[..., :3] - same[..., :3]), mine[..., 3:]), -1)
    u_left = torch.where((tied > 0)[:, None, None], mixed, mine)
    left = solve_arm(table, hand_b, u_left, other, phase, amp, None if keep is None else keep.left)

    gaze = turn(chest.mT, unit(right.wrist - head_at))
    to_turn = torch.atan2(gaze[:, 0], -gaze[:, 1].clamp(max=-0.05)).clamp(-1.2, 1.2)
    to_nod = -torch.asin(gaze[:, 2].clamp(-1, 1)).clamp(-0.95, 1.0)
    looks = look & (table.hand[hand_a, 0] != FRAMES.index("head")) & (table.hand[hand_b, 0] != FRAMES.index("head"))
    neck_l, head_l = _head(chest, to_nod.clamp(-0.8, 0.95), 0.5 * tip, to_turn)
    neck, head = (torch.where(looks[:, None, None], a, b) for a, b in ((neck_l, neck), (head_l, head)))

    rights = (right.clavicle, right.upper, right.fore, right.hand, right.fingers)
    lefts = tuple(r * both for r in (left.clavicle, left.upper, left.fore, left.hand, left.fingers))
    leg_parts = torch.stack((legs.thigh, legs.shin, legs.foot), 2)
    out = torch.stack((legs.pelvis, abdomen, chest, neck, head, *rights, *lefts), 1)
    out = torch.cat((out, leg_parts[:, 0], leg_parts[:, 1] * both), 1)
    out = down[:, None] @ out
    out = torch.where((pick_mirror < 0.5)[:, None, None, None], kin.mirror(out), out)
    return Solved(out, legs.clash + right.clash + left.clash, legs_kept, right.chosen, left.chosen)


def _head(chest: Tensor, nod: Tensor, tip: Tensor, head_turn: Tensor) -> tuple[Tensor, Tensor]:
    neck = chest @ rot(2, 0.4 * head_turn) @ rot(0, 0.45 * nod) @ rot(1, 0.45 * tip)
    return neck, chest @ rot(2, head_turn) @ rot(0, nod) @ rot(1, tip)


def _activities(n: int, generator: torch.Generator, mix: dict[str, float] | None) -> Tensor:
    shares = dict(ACTIVITIES) if mix is None else mix
    unknown = sorted(set(shares) - set(ACTIVITIES))
    if unknown:
        raise UnderstudyError(f"activity {unknown[0]!r}: must be {one_of(ACTIVITIES)}")
    weights = torch.tensor([float(shares.get(name, 0.0)) for name in NAMES])
    if not bool((weights >= 0).all()) or not float(weights.sum()) > 0 or not math.isfinite(float(weights.sum())):
        raise UnderstudyError("mix: shares must not be negative, and one must be above 0")
    u = torch.rand(n, generator=generator, device=generator.device).to("cpu")
    return _pick((weights / weights.sum()).cumsum(0).expand(n, -1), u)


def sample_poses(
    n: int, generator: torch.Generator, device: str = "cpu", mix: dict[str, float] | None = None
) -> PoseBatch:
    """Random postures.

    Args:
        n: how many.
        generator: source of randomness; its state alone decides the result.
        device: where the tensors shall be.
        mix: activity -> weight; activities left out do not occur. None: the default shares in `ACTIVITIES`.
    """
    activity = _activities(n, generator, mix)
    draws = draw(activity, generator, device)
    solved = solve(draws)
    rotations, clash = solved.rotations, solved.clash
    fine = within_limits(rotations)
    bad = (~fine | (clash > BAD_CLASH)).nonzero()[:, 0]
    if len(bad):  # a second try for the few that came out wrong
        again = solve(draw(draws.activity[bad], generator, device))
        better = within_limits(again.rotations) & (~fine[bad] | (again.clash < clash[bad]))
        rotations[bad[better]] = again.rotations[better]
        clash[bad[better]] = again.clash[better]
    return PoseBatch(rotations, draws.activity, clash)


def _ease(t: Tensor) -> Tensor:
    return t**3 * (10 - 15 * t + 6 * t * t)


def sequence(
    n_frames: int, generator: torch.Generator, activity: str | None = None, fps: float = 30.0, device: str = "cpu"
) -> Float[Tensor, "n 21 3 3"]:
    """A smooth motion of one activity: through a few key postures, or a gait cycle where the legs walk or run.

    Args:
        n_frames: length.
        generator: source of randomness.
        activity: one of `ACTIVITIES`; None draws one.
        fps: frames per second of the result.
        device: where the tensors shall be.
    """
    if n_frames < 1 or not fps > 0:
        raise UnderstudyError(f"sequence: n_frames {n_frames} and fps {fps} must be above 0")
    what = _activities(1, generator, None if activity is None else {activity: 1.0})
    table = tables_on(device)
    seconds = n_frames / fps
    n_keys = max(2, math.ceil(seconds / 0.9) + 1)
    draws = draw(what.expand(n_keys), generator, device)
    # the same legs, side and kind of trunk; the hands change now and then
    choices = draws.choices[:1].repeat(n_keys, 1)
    first = draws.take(torch.zeros(n_keys, dtype=torch.long))
    new_hands = draws.choices[:, 4] < 0.4
    choices[:, 1] = torch.where(new_hands, draws.choices[:, 1], choices[:, 1])
    near = 0.25
    keys = replace(
        draws,
        choices=choices,
        trunk=first.trunk + 0.5 * (draws.trunk - first.trunk),
        pelvis=first.pelvis + near * (draws.pelvis - first.pelvis),
        legs=first.legs + near * (draws.legs - first.legs),
    )
    lower = _pick(table.lower_choice[keys.activity[:1]], choices[:1, 0])
    gait = float(table.pelvis[lower, PELVIS_FIELDS.index("gait"), 0])
    times = torch.arange(n_frames, device=device) / fps
    if gait > 0:
        start = solve(keys.take(torch.zeros(1, dtype=torch.long, device=device)))
        rows = torch.zeros(n_frames, dtype=torch.long, device=device)
        cycle = keys.take(rows)
        rate = (0.8 + 0.3 * float(draws.choices[1, 3])) * (1.45 if gait > 1 else 1.0)
        choices = cycle.choices.clone()
        choices[:, 3] = (choices[:, 3] + rate * times) % 1
        kept = Solved(*(getattr(start, f.name)[rows] for f in fields(Solved)))
        return solve(replace(cycle, choices=choices), kept).rotations
    solved = solve(keys).rotations
    at = times / max(seconds, 1e-6) * (n_keys - 1)
    index = at.long().clamp(max=n_keys - 2)
    return interpolate(solved[index], solved[index + 1], _ease((at - index).clamp(0, 1)))
