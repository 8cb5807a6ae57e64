"""Legs and arms of a batch of postures: several candidates of each, of which the best is kept.

Both sides are computed in right-hand coordinates: x is mirrored for the left one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from understudy.synthetic import kinematics as kin
from understudy.synthetic.kinematics import along, cross, rot, turn, unit
from understudy.synthetic.pose_activities import PELVIS_FIELDS
from understudy.synthetic.pose_tables import CHOICES, SWIVELS_TRIED, TARGETS_TRIED, Draws, Tables, gait_cycles

# -- legs ----------------------------------------------------------------------------------------------------------


def _point_segment(points: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Distances [..., P, S] of points [..., P, 3] from line segments [..., S, 3]."""
    d = end - start
    length2 = (d * d).sum(-1).clamp_min(1e-8)
    pd = points @ d.mT - (start * d).sum(-1)[..., None, :]
    share = (pd / length2[..., None, :]).clamp(0, 1)
    pa2 = (points * points).sum(-1)[..., None] - 2 * points @ start.mT + (start * start).sum(-1)[..., None, :]
    return (pa2 - 2 * share * pd + share * share * length2[..., None, :]).clamp_min(0).sqrt()


@dataclass(frozen=True)
class Legs:
    """Legs in right-hand coordinates: axis `side` is (right, left with x mirrored)."""

    pelvis: Tensor  # [..., 3, 3]
    thigh: Tensor  # [..., 2, 3, 3]
    shin: Tensor
    foot: Tensor
    height: Tensor  # [...] hips above the floor
    cost: Tensor
    clash: Tensor


def solve_legs(table: Tables, lower: Tensor, draws: Draws, fold: Tensor, gait: Tensor) -> Legs:
    """All candidates' legs; leading shape [n, tried]."""
    device = lower.device
    span = table.pelvis[lower][:, None]
    tilt, roll, yaw, sx, sy, drop, gait_kind, kneel, amp, _, seat = (
        span[..., 0] + (span[..., 1] - span[..., 0]) * draws.pelvis
    ).unbind(-1)
    tilt = (tilt + fold[:, None]).clamp(max=1.25)
    pelvis = rot(2, yaw) @ rot(0, tilt) @ rot(1, roll)
    span = table.legs[lower][:, None]
    fk, flex, abd, turn_out, knee, o, f, lift, fyaw, fpitch, frel, out = (
        span[..., 0] + (span[..., 1] - span[..., 0]) * draws.legs
    ).unbind(-1)
    sign = torch.tensor([1.0, -1.0], device=device)
    lies = (table.pelvis[lower, PELVIS_FIELDS.index("lay"), 0] > 0.5)[:, None, None]
    quarter = torch.floor(draws.choices[:, CHOICES.index("lay")] * 4)[:, None, None]
    flex = torch.where(lies & (quarter == 2), 0.1 * flex, flex)  # on the belly
    abd = torch.where(lies & (quarter % 2 == 1), 0.2 * abd, abd)  # on a side
    phase = (gait[:, None] + torch.tensor([0.0, 0.5], device=device))[:, None].expand(fk.shape)
    index = (phase % 1) * 100
    first = index.long().clamp(0, 99)
    curves = gait_cycles(str(device))
    kind = (gait_kind[..., None] > 1.5).long().expand_as(first)
    part = (index - first)[..., None]
    cycle = curves[kind, first] * (1 - part) + curves[kind, (first + 1) % 100] * part
    walks = gait_kind[..., None] > 0.5
    wide = amp[..., None]
    flex = torch.where(walks, cycle[..., 0] * wide + 0.05 * (1 - wide), flex)
    knee = torch.where(walks, cycle[..., 1] * (0.35 + 0.65 * wide), knee)
    fpitch = torch.where(walks, cycle[..., 2] * wide, fpitch)
    # by angles
    thigh_fk = rot(0, -flex) @ rot(1, abd) @ rot(2, -turn_out)
    knee = torch.where(kneel[..., None] * fk > 0.5, knee + flex, knee)  # shins on the floor
    shin_fk = thigh_fk @ rot(0, knee)
    low = -kin.THIGH * thigh_fk[..., 2, 2]  # z of the knee under the hip
    ankle_low = low - kin.SHIN * shin_fk[..., 2, 2]
    height_fk = torch.where(
        kneel > 0.5,
        -torch.where(fk > 0.5, low, torch.zeros_like(low)).amin(-1) + 0.055,
        -ankle_low.amin(-1).clamp(max=-0.05) + kin.ANKLE_HEIGHT,
    )
    # by the foot's place: mirrored coordinates, x of the left side is turned over
    hip = torch.stack(
        (-kin.HIP_HALF * pelvis[..., 0, 0], -kin.HIP_HALF * pelvis[..., 1, 0], -kin.HIP_HALF * pelvis[..., 2, 0]), -1
    )
    hip = torch.stack((hip, torch.stack((hip[..., 0], -hip[..., 1], -hip[..., 2]), -1)), -2)
    back = sy + 0.17 * fold.clamp(0, 1.2)[:, None].sin()
    raised = torch.where(
        fpitch > 0,
        0.12 * fpitch.sin() + kin.ANKLE_HEIGHT * fpitch.cos(),
        0.05 * fpitch.abs().sin() + kin.ANKLE_HEIGHT * fpitch.cos(),
    )
    place_x, place_y = -o - sign * sx[..., None], -f - back[..., None]
    flat2 = (place_x - hip[..., 0]) ** 2 + (place_y - hip[..., 1]) ** 2
    longest = kin.THIGH + kin.SHIN - 0.003
    stretched = hip[..., 2] + (longest**2 - flat2).clamp_min(0.01).sqrt() + raised + lift
    stretched = torch.where(fk > 0.5, torch.full_like(stretched, 9.0), stretched).amin(-1)
    planted = (fk.amin(-1) < 0.5) & (kneel < 0.5)
    height = torch.where(seat > 0, seat, torch.where(planted, stretched - drop, height_fk))
    goal = torch.stack((place_x, place_y, raised + lift - height[..., None]), -1)
    knee_yaw = fyaw + out
    pole = torch.stack((-knee_yaw.sin(), -knee_yaw.cos(), torch.full_like(knee_yaw, 0.15)), -1)
    shortest = 0.16
    thigh_ik, shin_ik = kin.leg_frames(*kin.two_bone(hip, goal, pole, kin.THIGH, kin.SHIN, shortest))
    by_angle = (fk > 0.5)[..., None, None]
    thigh, shin = torch.where(by_angle, thigh_fk, thigh_ik), torch.where(by_angle, shin_fk, shin_ik)
    # feet: level, heading with the knee's axis; or relative to the shin
    across = shin[..., 0]
    level_yaw = torch.where(fk > 0.5, torch.atan2(across[..., 1], across[..., 0]), torch.zeros_like(fyaw)) - fyaw
    pitch = rot(0, fpitch)
    foot = torch.where((frel > 0.5)[..., None, None], shin @ pitch, rot(2, level_yaw) @ pitch)
    # costs: legs in each other, joints out of range
    knees = hip - kin.THIGH * thigh[..., 2]
    ankles = knees - kin.SHIN * shin[..., 2]
    toes = ankles + along(foot, (0.0, -0.16, -0.05))
    flip = torch.tensor([-1.0, 1.0, 1.0], device=device)
    own = torch.stack((hip, knees, ankles, toes), -2)
    right, left = own[..., 0, :, :], own[..., 1, :, :] * flip
    points = torch.cat((right[..., 1:, :], 0.5 * (right[..., 1:, :] + right[..., :-1, :])), -2)
    gap = _point_segment(points, left[..., :-1, :], left[..., 1:, :])
    points = torch.cat((left[..., 1:, :], 0.5 * (left[..., 1:, :] + left[..., :-1, :])), -2)
    gap2 = _point_segment(points, right[..., :-1, :], right[..., 1:, :])
    clash = (0.10 - gap.amin((-2, -1))).clamp_min(0) + (0.10 - gap2.amin((-2, -1))).clamp_min(0)
    local = pelvis_local(pelvis, thigh)
    hip_flex = torch.atan2(-local[..., 1], -local[..., 2])
    excess = (hip_flex - 2.6).clamp_min(0) * (hip_flex < 2.8) + (-0.8 - hip_flex).clamp_min(0) * (hip_flex > -2.5)
    excess = excess + (local[..., 0] - 0.65).clamp_min(0)
    ankle = kin.angle_of(shin.mT @ foot)
    below = (-height[..., None] + 0.03 - torch.minimum(ankles[..., 2], toes[..., 2])).clamp_min(0)
    cost = 20 * clash + (3 * excess + 3 * (ankle - 1.2).clamp_min(0) + 2 * below).sum(-1) + 0.02 * draws.pelvis[..., -1]
    return Legs(pelvis, thigh, shin, foot, height, cost, clash)


def pelvis_local(pelvis: Tensor, thigh: Tensor) -> Tensor:
    """Thighs' directions [..., 2, 3] in the pelvis' frame, x mirrored for the left one."""
    flip = torch.tensor([-1.0, 1.0, 1.0], device=pelvis.device)
    mirrored = torch.stack((pelvis, pelvis * (flip[:, None] * flip)), -3)
    return -turn(mirrored.mT, thigh[..., 2])


# -- arms ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Arm:
    """One arm in right-hand coordinates."""

    clavicle: Tensor  # [n, 3, 3] ...
    upper: Tensor
    fore: Tensor
    hand: Tensor
    fingers: Tensor
    elbow: Tensor  # [n, 3] ...
    wrist: Tensor
    clash: Tensor  # [n]
    chosen: Tensor  # [n]


@dataclass(frozen=True)
class Body:
    """What the arms need to know of the rest, in right-hand coordinates (x mirrored for the left arm)."""

    pelvis: Tensor
    chest: Tensor
    head: Tensor
    chest_at: Tensor  # origins [n, 3]
    head_at: Tensor
    knee: Tensor
    thigh: Tensor
    height: Tensor
    up: Tensor  # [n, 3] out of the floor, which is `under` below the hips
    under: Tensor
    starts: Tensor  # capsules [n, C, 3]
    ends: Tensor
    radii: Tensor  # [C]

    def mirrored(self) -> Body:
        """For the left arm; knees and capsules are the caller's to set."""
        flip = torch.tensor([-1.0, 1.0, 1.0], device=self.pelvis.device)
        both = flip[:, None] * flip
        frames = {name: getattr(self, name) * both for name in ("pelvis", "chest", "head", "thigh")}
        points = ("chest_at", "head_at", "knee", "up", "starts", "ends")
        return replace(self, **frames, **{name: getattr(self, name) * flip for name in points})


def solve_arm(
    table: Tables, style: Tensor, u: Tensor, body: Body, phase: Tensor, amp: Tensor, chosen: Tensor | None
) -> Arm:
    """Try targets and swivels of the right arm; keep the best (or the `chosen` one).

    Args:
        style: [n] hand style.
        u: [n, tried, 12] uniform numbers.
        body: the rest of the body, in right-hand coordinates.
        phase: [n] phase of the opposite leg, for swinging arms.
        amp: [n] how wide the swing is.
        chosen: [n] candidates to take, or None.
    """
    n = len(style)
    device = style.device
    frame_i, fk, ball, free, swing, wrist_spread, curl_low, curl_high = table.hand[style].unbind(-1)
    frame_i = frame_i.long()
    eye = torch.eye(3, device=device).expand(n, 3, 3)
    clavicle_at = body.chest_at + along(body.chest, (-0.02, 0.0, 0.22))
    shoulder = clavicle_at + along(body.chest, (-kin.SHOULDER[0], 0.0, 0.0))
    ground = torch.stack((torch.zeros_like(body.height), torch.zeros_like(body.height), -body.height), -1)
    breast = clavicle_at + along(body.chest, (0.02, 0.0, 0.0))
    ears = body.head_at + along(body.head, (0.0, 0.0, 0.08))
    places = torch.stack((shoulder, shoulder, torch.zeros_like(shoulder), breast, ears, body.knee, ground), 1)
    frames = torch.stack((body.chest, eye, body.pelvis, body.chest, body.head, body.thigh, eye), 1)
    rows = torch.arange(n, device=device)
    place, frame = places[rows, frame_i], frames[rows, frame_i]
    # the wrist's target: one for every group of swivels
    span = table.box[style][:, None]
    target_u = u[:, ::SWIVELS_TRIED, :3].repeat_interleave(SWIVELS_TRIED, 1)
    spot = span[..., 0] + (span[..., 1] - span[..., 0]) * target_u
    azimuth, elevation, distance = spot.unbind(-1)
    level = distance * elevation.cos()
    round_spot = torch.stack((level * azimuth.sin(), level * azimuth.cos(), distance * elevation.sin()), -1)
    spot = torch.where((ball > 0.5)[:, None, None], round_spot, spot)
    wave = (swing * amp * (2 * math.pi * phase).cos())[:, None]  # in front when the other leg is
    shift = torch.stack((torch.zeros_like(wave), 0.2 * wave, 0.04 * wave.abs()), -1)
    spot = spot + shift
    spot = spot * torch.tensor([-1.0, -1.0, 1.0], device=device)
    target = place[:, None] + (frame[:, None] @ spot[..., None])[..., 0]
    # free arms: any direction
    z = 2 * u[..., 0] - 1
    around = 2 * math.pi * u[..., 1]
    ring = (1 - z * z).clamp_min(0).sqrt()
    chest = body.chest[:, None]
    free_dir = turn(chest, torch.stack((ring * around.cos(), ring * around.sin(), z), -1))
    # collar bone: up and forward with the arm
    is_fk = (fk > 0.5)[:, None]
    heading = torch.where(is_fk[..., None], free_dir, (target - shoulder[:, None]) / 0.5)
    heading = turn(chest.mT, heading)
    lift = (0.12 + 0.5 * heading[..., 2].clamp(-0.6, 1)) * 0.75
    ahead = -0.28 * heading[..., 1].clamp(-0.7, 1.0)
    clavicle = chest @ rot(2, ahead) @ rot(1, lift)
    shoulder = clavicle_at[:, None] + along(clavicle, (-kin.SHOULDER[0], 0.0, 0.0))
    # by target: swivel the elbow around the line from shoulder to wrist
    line = unit(target - shoulder)
    liking = table.elbow[style] * torch.tensor([-1.0, -1.0, 1.0], device=device)
    liking = unit(turn(body.chest, liking))[:, None]
    base = unit(cross(line, liking.expand_as(line) + 1e-3))
    other = cross(base, line)  # towards where the elbow likes to be
    steps = torch.arange(SWIVELS_TRIED, device=device).repeat(TARGETS_TRIED)
    swivel = ((steps + u[..., 3]) / SWIVELS_TRIED - 0.5) * (2 * math.pi)
    swivel = swivel * (0.35 + 0.65 * (swivel / math.pi) ** 2)  # denser about the liked side
    pole = other * swivel.cos()[..., None] + base * swivel.sin()[..., None]
    first, second, hinge = kin.two_bone(shoulder, target, pole, kin.UPPER_ARM, kin.FOREARM, 0.15)
    upper_ik, fore_ik = kin.arm_frames(first, second, hinge)
    # by angles
    swung = _shortest_turn(-chest[..., 0], free_dir) @ chest @ rot(0, (2 * u[..., 2] - 1) * 1.6)
    bend = 2.6 * u[..., 3] ** 1.2
    upper = torch.where(is_fk[..., None, None], swung, upper_ik)
    fore = torch.where(is_fk[..., None, None], swung @ rot(2, bend), fore_ik)
    elbow = shoulder - kin.UPPER_ARM * upper[..., 0]
    wrist = elbow - kin.FOREARM * fore[..., 0]
    # what it costs
    points = torch.stack((elbow, elbow + (wrist - elbow) * 0.35, elbow + (wrist - elbow) * 0.7, wrist,
                          wrist - 0.06 * fore[..., 0], wrist - 0.12 * fore[..., 0]), 2)  # fmt: skip
    own = torch.tensor([0.03, 0.04, 0.035, 0.03, 0.03, 0.02], device=device)
    gap = _point_segment(points.flatten(1, 2), body.starts, body.ends).unflatten(1, points.shape[1:3])
    inside = (own[:, None] + body.radii - gap).clamp_min(0)
    clash = inside.amax(-1).sum(-1)
    relative = chest.mT @ upper
    twist = kin.twist_x(relative)
    limits = kin.shoulder_excess(-relative[..., 0], twist)
    comfort = torch.where(is_fk, torch.zeros_like(twist), 0.25 * (1 - (pole * liking).sum(-1)) + 0.08 * twist**2)
    ends = torch.stack((elbow, wrist, wrist - 0.1 * fore[..., 0]), -2)
    floor = (0.03 - body.under[:, None, None] - (ends * body.up[:, None, None]).sum(-1)).clamp_min(0).sum(-1)
    short = (wrist - target).norm(dim=-1) * ~is_fk
    total = 25 * clash + 12 * limits + comfort + 5 * floor + 1.0 * short + 0.25 * u[..., 4]
    best = total.argmin(1) if chosen is None else chosen
    clavicle, upper, fore, elbow, wrist, line = (
        v[rows, best] for v in (clavicle, upper, fore, elbow, wrist, fore[..., 0])
    )
    noise = u[rows, best]
    # forearm and hand: the palm as the style wants it
    wish = unit(table.palm[style] + 0.8 * (noise[:, 5:8] - 0.5)) * torch.tensor([-1.0, -1.0, 1.0], device=device)
    wish = turn(fore.mT, turn(frame, wish))
    free_palm = free > 0.5
    pronation = torch.where(
        free_palm,
        (noise[:, 8] * 2 - 1) * 1.4,
        torch.atan2(wish[:, 1], -wish[:, 2]).clamp(-1.4, 1.4) + 0.4 * (noise[:, 8] - 0.5),
    )
    rolled = turn(rot(0, -pronation), wish)
    flexion = torch.atan2(rolled[:, 0], -rolled[:, 2]).clamp(-1.15, 1.2) * 0.75
    spread = wrist_spread * (noise[:, 9] * 2 - 1)
    flexion = torch.where(free_palm, spread, (flexion + spread).clamp(-1.2, 1.3))
    deviation = (noise[:, 10] * 2 - 1) * 0.45 * wrist_spread.clamp(max=0.8)
    hand = fore @ rot(0, pronation) @ rot(1, -flexion) @ rot(2, deviation)
    fingers = hand @ rot(1, -(curl_low + (curl_high - curl_low) * noise[:, 11]))
    fore = fore @ rot(0, 0.5 * pronation)
    return Arm(clavicle, upper, fore, hand, fingers, elbow, wrist, clash[rows, best], best)


def _shortest_turn(a: Tensor, b: Tensor) -> Tensor:
    """The smallest rotation that takes unit vectors `a` to `b` ([..., 3] each, not opposite)."""
    v = torch.broadcast_tensors(cross(a.expand_as(b), b), b)[0]
    c = (a * b).sum(-1)[..., None, None]
    zero = torch.zeros_like(v[..., 0])
    x, y, w = v.unbind(-1)
    k = torch.stack((zero, -w, y, w, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
    eye = torch.eye(3, device=v.device)
    return eye + k + k @ k / (1 + c).clamp_min(1e-4)
