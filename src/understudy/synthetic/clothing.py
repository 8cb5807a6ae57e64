"""Random clothes, shoes, hair, hats and carried things for the bodies of a bank, as shifts of their surface points.

Clothes move the rest points outward by a thickness that depends on the region and ends at hems; folds are a few random
waves. Everything is drawn per person from one generator. Faces and hands stay bare.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from understudy.skeleton import JOINT
from understudy.synthetic.bodies import REGION, BodyBank
from understudy.synthetic.carried import N_EXTRA, carry
from understudy.synthetic.segments import SEGMENT

N_WAVES: Final = 5
"""Sinusoids whose sum makes the folds."""


@dataclass(frozen=True)
class Style:
    """What B people wear. Lengths in metres.

    Hems are given downward along the body: -1 at the chest's origin, 0 at the crotch, 1 at the knee, 2 at the ankle;
    the sleeve along the arm: 0 shoulder, 1 elbow, 2 wrist.
    """

    top: Float[Tensor, " b"]
    """thickness of shirt, jacket or coat at the trunk"""
    top_hem: Float[Tensor, " b"]
    sleeve: Float[Tensor, " b"]
    sleeve_room: Float[Tensor, " b"]
    """thickness at the arms"""
    coat: Bool[Tensor, " b"]
    """bridges the gap between the legs above `top_hem`"""
    bottom: Float[Tensor, " b"]
    """thickness of trousers at the thighs"""
    bottom_hem: Float[Tensor, " b"]
    flare: Float[Tensor, " b"]
    """what trousers or a skirt gain in radius from hip to knee"""
    skirt: Bool[Tensor, " b"]
    folds: Float[Tensor, " b"]
    """amplitude of the folds"""
    sole: Float[Tensor, " b"]
    """thickness; 0 barefoot"""
    shoe: Float[Tensor, " b"]
    """thickness of the upper"""
    hair: Float[Tensor, " b"]
    """thickness; 0 bald"""
    long_hair: Float[Tensor, " b"]
    """how far it falls below the head; 0 for short hair"""
    bun: Bool[Tensor, " b"]
    hat: Int[Tensor, " b"]
    """0 none, 1 close cap, 2 cap with a brim, 3 hood"""
    scarf: Float[Tensor, " b"]
    """thickness around the neck; 0 none"""
    belly: Float[Tensor, " b"]
    """a paunch, in front"""
    carried: Int[Tensor, " b"]
    """code of `carried.THINGS`"""
    dark_hair: Bool[Tensor, " b"]
    dark_top: Bool[Tensor, " b"]
    dark_bottom: Bool[Tensor, " b"]
    dark_shoes: Bool[Tensor, " b"]


@dataclass(frozen=True)
class Dressed:
    """B dressed bodies at rest; `bodies.pose` and `bodies.pose_extra` take them from here."""

    points: Float[Tensor, "b p 3"]
    normals: Float[Tensor, "b p 3"]
    dark: Bool[Tensor, "b p"]
    """hair and cloth that reflect little near infrared light"""
    bridge: Float[Tensor, "b p"]
    """share of the way to the other leg, 0..0.5; to be given to `pose`"""
    extra: Float[Tensor, "b e 3"]
    """points of carried things, rest frame; NaN where absent"""
    extra_normals: Float[Tensor, "b e 3"]
    extra_segment: Int[Tensor, "b e"]
    carried: Int[Tensor, " b"]
    """code of `carried.THINGS`: lets a pose match, e.g. both hands at a box"""
    carried_size: Float[Tensor, "b 3"]
    """of the thing, metres; boxes in hands: (along the hand, across it, out of the palm)"""


def draw_style(bank: BodyBank, ids: Int[Tensor, " b"], generator: torch.Generator) -> Style:
    """Random clothing. The generator may be on the CPU or on the bank's device."""
    n, device = len(ids), bank.device
    female = bank.female[ids]
    numbers = torch.rand(40, n, generator=generator, device=generator.device).to(device)
    rows = iter(numbers)

    def chance(p: float | Tensor) -> Tensor:
        return next(rows) < p

    def between(low: float, high: float) -> Tensor:
        return low + (high - low) * next(rows)

    def pick(kind: Tensor, *choices: Tensor) -> Tensor:
        return torch.stack(choices, 1).gather(1, kind[:, None])[:, 0]

    def kinds(*shares: float) -> Tensor:
        edges = torch.tensor(shares, device=device).cumsum(0)[:-1]
        return torch.bucketize(next(rows).contiguous(), edges)

    zero = torch.zeros(n, device=device)
    top = kinds(0.16, 0.30, 0.28, 0.18, 0.08)  # tight, T-shirt, long sleeves, jacket, coat
    u = between(0.0, 1.0)
    sleeve = pick(
        top, *(low + (high - low) * u for low, high in ((0.0, 1.9), (0.3, 0.9), (1.1, 1.97), (1.8, 2.0), (1.85, 2.0)))
    )
    u = between(0.0, 1.0)
    thick = pick(
        top,
        *(
            low + (high - low) * u
            for low, high in ((0.002, 0.006), (0.006, 0.022), (0.007, 0.026), (0.02, 0.05), (0.025, 0.05))
        ),
    )
    u = between(0.0, 1.0)
    hem = pick(
        top,
        *(low + (high - low) * u for low, high in ((-0.5, 0.0), (-0.4, 0.1), (-0.4, 0.15), (-0.4, 0.25), (0.6, 1.1))),
    )
    skirt = chance(torch.where(female, 0.22, 0.01))
    legs = kinds(0.34, 0.46, 0.20)  # tight, loose, shorts
    u = between(0.0, 1.0)
    leg_hem = pick(legs, 1.5 + 0.48 * u, 1.8 + 0.18 * u, 0.35 + 0.65 * u)
    leg_hem = torch.where(skirt, 0.45 + 1.4 * between(0.0, 1.0), leg_hem)
    u = between(0.0, 1.0)
    bottom = torch.where(skirt, 0.01 + 0.02 * u, pick(legs, 0.002 + 0.006 * u, 0.01 + 0.025 * u, 0.008 + 0.03 * u))
    u = between(0.0, 1.0)
    flare = torch.where(skirt, 0.09 * u, pick(legs, zero, 0.025 * u, 0.02 * u))
    bald = chance(torch.where(female, 0.01, 0.14))
    long_hair = chance(torch.where(female, 0.5, 0.05)) & ~bald
    hat = kinds(0.80, 0.07, 0.08, 0.05)
    heel = chance(0.93)
    return Style(
        top=thick,
        top_hem=hem,
        sleeve=sleeve,
        sleeve_room=thick * between(0.4, 1.1),
        coat=top == 4,
        bottom=bottom,
        bottom_hem=leg_hem,
        flare=flare,
        skirt=skirt,
        folds=between(0.002, 0.014),
        sole=torch.where(heel, between(0.015, 0.045), zero),
        shoe=torch.where(heel, between(0.004, 0.012), zero),
        hair=torch.where(bald, zero, between(0.004, 0.035)),
        long_hair=torch.where(long_hair, between(0.06, 0.24), zero),
        bun=chance(torch.where(female, 0.22, 0.01)) & ~long_hair & ~bald,
        hat=hat,
        scarf=torch.where(chance(0.08), between(0.02, 0.05), zero),
        belly=torch.where(chance(0.2), between(0.01, 0.06), zero),
        carried=kinds(0.70, 0.10, 0.06, 0.05, 0.04, 0.05),
        dark_hair=chance(0.5),
        dark_top=chance(0.15),
        dark_bottom=chance(0.2),
        dark_shoes=chance(0.35),
    )


def dress(bank: BodyBank, ids: Int[Tensor, " b"], generator: torch.Generator, style: Style | None = None) -> Dressed:
    """Dresses bodies of the bank at rest. style: what they wear, default drawn at random."""
    style = style or draw_style(bank, ids, generator)
    points, normals = bank.points[ids], bank.normals[ids]
    wear = {f.name: getattr(style, f.name)[:, None] for f in fields(style)}
    low, arm = _places(bank)
    masks = {name: bank.region == code for name, code in REGION.items()}

    top_on, bottom_on = _covers(masks, low, arm, wear)
    thick = _thickness(bank, masks, low, wear, top_on, bottom_on, points, normals, bank.drape[ids])
    thick, normals = _fold(points, normals, thick, top_on | bottom_on, style.folds, generator)
    out = torch.addcmul(points, normals, thick[..., None])
    hair_on = _hair(bank, ids, masks, style, points, out)
    _shoes(masks, wear, bank.along, points, out)
    bridge = torch.zeros_like(thick)
    _skirts(bank, ids, masks, low, style, points, out, normals, bridge)

    hat_on = masks["scalp"] & (wear["hat"] > 0)
    dark = (top_on & wear["dark_top"]) | (bottom_on & ~top_on & wear["dark_bottom"])
    dark |= (hair_on & ~hat_on & wear["dark_hair"]) | (hat_on & wear["dark_top"])
    dark |= masks["foot"] & (wear["sole"] > 0) & wear["dark_shoes"]
    extra, extra_normals, extra_segment, size = carry(bank, ids, style.carried, style.hat == 2, style.top, generator)
    return Dressed(out, normals, dark, bridge, extra, extra_normals, extra_segment, style.carried, size)


def _places(bank: BodyBank) -> tuple[Tensor, Tensor]:
    """(P,) places downward along trunk and legs, and along the arms, as hems and sleeves are given."""
    region, along = bank.region, bank.along
    low = torch.full_like(along, -2.0)
    for name, start, sign in (("trunk_lower", 0.0, -1.0), ("thigh", 0.0, 1.0), ("shin", 1.0, 1.0), ("foot", 3.0, 0.0)):
        low = torch.where(region == REGION[name], start + sign * along, low)
    arm = torch.full_like(along, 9.0)
    for name, start in (("upper_arm", 0.0), ("forearm", 1.0)):
        arm = torch.where(region == REGION[name], start + along, arm)
    return low, arm


def _covers(masks: dict[str, Tensor], low: Tensor, arm: Tensor, wear: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """(B, P) where the upper and the lower garment are."""
    trunk = masks["trunk_upper"] | masks["trunk_lower"]
    legs = masks["thigh"] | masks["shin"]
    top = (trunk | legs) & (low < wear["top_hem"]) | (arm < wear["sleeve"])
    bottom = (masks["trunk_lower"] & (low > -0.62)) | (legs & (low < wear["bottom_hem"]))
    return top, bottom


def _thickness(
    bank: BodyBank,
    masks: dict[str, Tensor],
    low: Tensor,
    wear: dict[str, Tensor],
    top_on: Tensor,
    bottom_on: Tensor,
    points: Tensor,
    normals: Tensor,
    hollow: Tensor,
) -> Tensor:
    """(B, P) thickness of the clothes, metres; hair and shoes are not in it."""
    arms = masks["upper_arm"] | masks["forearm"]
    hang = 0.8 + 0.5 * (low + 1).clamp(0, 1.5)  # loose cloth stands off more below
    hang = torch.where(masks["trunk_upper"], 0.45 + 0.35 * (1 - bank.along), hang)
    upper = torch.where(arms, wear["sleeve_room"], wear["top"] * hang)
    lower = wear["bottom"] + wear["flare"] * low.clamp(0, 2)
    lower = torch.where(masks["trunk_lower"], 0.4 * wear["bottom"].clamp(max=0.015), lower)
    thick = torch.where(top_on, upper, 0.0)
    thick = torch.where(
        bottom_on & top_on, torch.maximum(thick, lower + 0.25 * thick), thick + torch.where(bottom_on, lower, 0.0)
    )
    taut = (wear["top"] / 0.012).clamp(0.3, 0.95) * top_on + 0.5 * (bottom_on & ~top_on)
    thick = thick + taut * hollow
    paunch = (-normals[..., 1]).clamp_min(0) * torch.exp(-(((points[..., 2] - 0.11) / 0.13) ** 2))
    thick = thick + torch.where(masks["trunk_lower"], wear["belly"] * paunch, 0.0)
    return thick + torch.where(masks["neck"], wear["scarf"], 0.0)


def _fold(
    points: Tensor, normals: Tensor, thick: Tensor, cloth: Tensor, amplitude: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Thickness and normals with folds: waves of 7 to 45 cm, at most 0.7 times the thickness deep."""
    n = len(points)
    random = torch.randn(n, 3, N_WAVES, generator=generator, device=generator.device).to(points)
    phase = torch.rand(n, 2, N_WAVES, generator=generator, device=generator.device).to(points)
    length = 0.07 * (0.45 / 0.07) ** phase[:, 0]
    waves = torch.nn.functional.normalize(random, dim=1) * (2 * torch.pi / length)[:, None]
    share = length / length.sum(1, keepdim=True)  # long waves are deep
    angle = torch.baddbmm(2 * torch.pi * phase[:, 1:], points, waves)
    deep = torch.minimum(amplitude[:, None] * 2, 0.7 * thick) * cloth
    height = (angle.sin() @ share[..., None])[..., 0]
    slope = angle.cos_() @ (waves * share[:, None]).mT
    slope *= deep[..., None]
    slope -= normals * (slope * normals).sum(2, keepdim=True)
    bent = normals - slope
    return thick + deep * height, bent * bent.square().sum(2, keepdim=True).rsqrt_()


def _hair(bank: BodyBank, ids: Tensor, masks: dict[str, Tensor], style: Style, points: Tensor, out: Tensor) -> Tensor:
    """Moves the points of the head in place; returns (B, P) where hair or a hat is."""
    on = torch.zeros(points.shape[:2], dtype=torch.bool, device=points.device)
    picked = (masks["scalp"] | masks["neck"] | masks["trunk_upper"]).nonzero()[:, 0]
    scalp, neck, back = (masks[m][picked] for m in ("scalp", "neck", "trunk_upper"))
    p, normal = points[:, picked], bank.normals[ids[:, None], picked]
    size = (bank.stature[ids] / 1.7)[:, None]
    joints = bank.joints[ids]
    ear = joints[:, [JOINT["right_ear"], JOINT["left_ear"]]].mean(1)
    crown_up = ((p[..., 2] - ear[:, None, 2]) / 0.12).clamp(0, 1)
    behind = ((p[..., 1] - ear[:, None, 1]) / 0.05 + 0.5).clamp(0, 1)

    shift = style.hair[:, None] * (0.35 + 0.65 * crown_up)
    hat = style.hat[:, None]
    shift = torch.where(hat > 0, 0.4 * shift + 0.008, shift) + 0.025 * (hat == 3)
    knot = ear[:, None] + size[..., None] * p.new_tensor([0.0, 0.10, 0.055])
    shift = shift + style.bun[:, None] * 0.055 * torch.exp(-(((p - knot) / 0.035) ** 2).sum(2))
    shift = shift * scalp
    moved = p + normal * shift[..., None]

    # long hair and hoods: neck and upper back are hidden behind a curtain around the neck
    axis = bank.origins[ids, SEGMENT["neck"]][:, None]
    flat = (p - axis)[..., :2]
    radius = flat.norm(dim=2).clamp_min(1e-3)
    curtain = 0.082 * size + 0.7 * style.hair[:, None].clamp_max(0.03) + 0.01 * (hat == 3)
    falls = torch.where(hat == 3, 0.05, style.long_hair[:, None])
    depth = axis[..., 2] + 0.09 - p[..., 2]  # below the base of the skull
    reached = (falls > 0) & (depth < falls + 0.06)
    ring = neck & reached
    grow = (curtain / radius - 1).clamp_min(0) * ring * behind
    moved[..., :2] += flat * grow[..., None]
    cape = back & reached & (radius < 0.13) & (p[..., 1] > axis[..., 1] - 0.02)
    moved += normal * (0.022 * cape * behind)[..., None]
    out[:, picked] = torch.where(
        (scalp | ring | cape)[..., None],
        torch.where(scalp[:, None], moved, moved + (out[:, picked] - p)),
        out[:, picked],
    )
    on[:, picked] = (scalp & (style.hair > 0)[:, None]) | (ring | cape) & (behind > 0.3)
    return on


def _shoes(masks: dict[str, Tensor], wear: dict[str, Tensor], along: Tensor, points: Tensor, out: Tensor) -> None:
    """Soles below, uppers around, toes a little longer; in place."""
    foot = masks["foot"].nonzero()[:, 0]
    p, t = points[:, foot], along[foot]
    bottom = p[..., 2].amin(1, keepdim=True)
    under = 1 - ((p[..., 2] - bottom) / 0.022).clamp(0, 1)
    centre = p[..., 0].new_tensor(0.0)
    shift = (out[:, foot] - p) * 0 + 0.0
    shift[..., 2] = -wear["sole"] * under * (0.75 + 0.5 * (1 - t)) + 0.6 * wear["shoe"] * (1 - under)
    shift[..., 1] = -wear["shoe"] * 2.0 * (t - 0.6).clamp_min(0) / 0.4 + wear["shoe"] * (0.15 - t).clamp_min(0) / 0.15
    for sign in (-1.0, 1.0):
        side = (p[..., 0] * sign > centre) & (wear["sole"] > 0)
        middle = (p[..., 0] * side).sum(1, keepdim=True) / side.sum(1, keepdim=True).clamp_min(1)
        shift[..., 0] += side * wear["shoe"] * ((p[..., 0] - middle) / 0.035).clamp(-1, 1)
    out[:, foot] = p + shift


def _skirts(
    bank: BodyBank,
    ids: Tensor,
    masks: dict[str, Tensor],
    low: Tensor,
    style: Style,
    points: Tensor,
    out: Tensor,
    normals: Tensor,
    bridge: Tensor,
) -> None:
    """Puts the points of both legs onto one tube around them, in place.

    The outer half of each leg grows to the tube's radius; the inner half is spread over the flat front and back between
    the legs: it stands straight before or behind its leg, and `bridge` says how far it goes to the other one.
    """
    wearers = (style.skirt | style.coat).nonzero()[:, 0]
    if not len(wearers):
        return
    rows = wearers[:, None]
    skirt = style.skirt[wearers]
    hem = torch.maximum(
        torch.where(skirt, style.bottom_hem[wearers], -1.0),
        torch.where(style.coat[wearers], style.top_hem[wearers], -1.0),
    )
    thick = torch.where(style.coat[wearers], style.top[wearers], style.bottom[wearers])
    flare = torch.where(skirt, style.flare[wearers], 0.03)
    size = (bank.stature[ids[wearers]] / 1.7)[:, None]
    for side, sign in (("right", -1.0), ("left", 1.0)):
        for part, child in (("thigh", "shin"), ("shin", "foot")):
            segment = SEGMENT[f"{side}_{part}"]
            picked = (masks[part] & (bank.segment == segment)).nonzero()[:, 0]
            align = bank.align[ids[wearers], segment]
            start = bank.origins[ids[wearers], segment][:, None]
            axis = bank.origins[ids[wearers], SEGMENT[f"{side}_{child}"]][:, None] - start
            t = bank.along[picked][None, :, None]
            local = (points[rows, picked] - start - t * axis) @ align.mT  # canonical: x to the left, y back, z up
            u, w = sign * local[..., 0], local[..., 1]  # outward, back
            r = (u.square() + w.square()).sqrt().clamp_min(1e-6)
            tube = torch.maximum(
                r + thick[:, None], 0.082 * size + thick[:, None] + flare[:, None] * low[picked].clamp(0, 1.3)
            )
            inner = u < 0
            u_new = torch.where(inner, 0.0, u / r)
            w_new = torch.where(inner, torch.where(w < 0, -1.0, 1.0), w / r)
            share = torch.where(inner, 0.5 - torch.asin((w.abs() / r).clamp(max=1.0)) / torch.pi, 0.0)
            outward = torch.stack([sign * u_new, w_new, torch.zeros_like(u)], 2)
            new = torch.cat([outward[..., :2] * tube[..., None], local[..., 2:]], 2)
            on = low[picked] < hem[:, None]
            place = start + t * axis + new @ align
            out[rows, picked] = torch.where(on[..., None], place, out[rows, picked])
            normals[rows, picked] = torch.where(on[..., None], outward @ align, normals[rows, picked])
            bridge[rows, picked] = torch.where(on, share, bridge[rows, picked])


__all__ = ["N_EXTRA", "Dressed", "Style", "draw_style", "dress"]
