"""Colour crops of simulated hands: shaded skin, cloth and things of random colours before random rooms.

Not photographs: light, skin, cloth and rooms are drawn so differently that what is left to learn is the hand's shape.
Coordinates are those of the crop view (`understudy.hands.crop`), origin in the colour camera; metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from understudy.hands.crop import PIXEL, PIXELS
from understudy.synthetic import render
from understudy.synthetic.draw import Draw
from understudy.synthetic.hand_clothes import SKIN

COARSE: Final = 4
"""pixels of the image's in one of the body's"""

_SKIN = ((0.30, 0.19, 0.13), (0.95, 0.77, 0.66))
_TAPS = 9  # of the blur's kernel
_REACH, _CREASE = 0.15, 0.06  # metres: what is farther from the hand, or from a crease's edges, casts no shade
_SOFT = 0.45  # pixels: blur of every image, one sigma


@dataclass(frozen=True)
class HandScene:
    """What is seen around each hand of a batch."""

    skin: Float[Tensor, "b p 3"]
    """points of hand and forearm; NaN for those that face away"""
    normals: Float[Tensor, "b p 3"]
    hand_wear: Int[Tensor, "b p"]
    """UPPER, LOWER or SKIN (`hand_clothes`) of these points"""
    palm: Float[Tensor, "b 3"]
    """the palm's normal"""
    held: Float[Tensor, "b q 3"]
    body: Float[Tensor, "b n 3"]
    body_wear: Int[Tensor, " n"]
    z_boxes: Float[Tensor, "b s s"]
    """depth of the furniture"""
    z_board: Float[Tensor, "b s s"]
    board_wear: Int[Tensor, " b"]
    """UPPER or LOWER where the board is cloth, otherwise -1"""
    distance: Float[Tensor, " b"]
    pixel: Float[Tensor, " b"]
    """metres at the hand of a pixel of the colour camera"""


def hand_image(draw: Draw, scene: HandScene) -> UInt8[Tensor, "b 3 72 72"]:
    """RGB images around the hands."""
    b, scale = len(scene.palm), scene.distance / PIXEL
    tone, upper, lower = _skin(draw, b), _cloth(draw, b), _cloth(draw, b)
    worn = torch.stack([upper, lower, tone], 1)
    z_hand, near = _hand(draw, scene, worn, scale)
    z_body, body = _body(draw, scene, worn, scale)
    layers = torch.stack([z_hand, z_body, scene.z_board, scene.z_boxes, torch.full_like(z_hand, render.FAR - 1)], 1)
    board, room, wall = (_surface(draw, b) for _ in range(3))
    board = torch.where((scene.board_wear < 0)[:, None, None, None], board, _cloth_of(draw, worn, scene.board_wear))
    near = near * _creases(draw, z_hand, scene.distance)[:, None]
    colors = torch.stack([near, body, board, room, wall], 1)
    first = layers.argmin(1)[:, None, None].expand(-1, 1, 3, -1, -1)
    image = _blurred(colors.gather(1, first)[:, 0], (_SOFT**2 + (0.5 * scene.pixel / PIXEL) ** 2).sqrt())
    image = image + draw.uniform(0.005, 0.04, b, 1, 1, 1) * draw.normal(*image.shape)
    return (image.clamp(0, 1) * 255).round().to(torch.uint8)


def _hand(
    draw: Draw, scene: HandScene, worn: Float[Tensor, "b 3 3"], scale: Float[Tensor, " b"]
) -> tuple[Float[Tensor, "b s s"], Float[Tensor, "b 3 s s"]]:
    """Depth and colour of hand, forearm and what is held."""
    b, p, q = len(worn), scene.skin.shape[1], scene.held.shape[1]
    z, which = render.splat_which(torch.cat([scene.skin, scene.held], 1), scale, PIXELS)
    tone = worn[:, SKIN]
    paler = draw.uniform(0, 0.35, b)[:, None] * (1 - tone.mean(1, keepdim=True))
    inner = (scene.normals * scene.palm[:, None]).sum(-1) > 0.3  # of dark hands the palms are paler
    inner &= scene.hand_wear == SKIN
    albedo = worn.gather(1, scene.hand_wear[..., None].expand(-1, -1, 3))
    albedo = torch.where(inner[..., None], (tone + paler * (1 - tone))[:, None], albedo)
    light = F.normalize(draw.normal(b, 3) + torch.tensor([0.0, 0.0, -0.8]), dim=1)
    ambient = draw.uniform(0.35, 0.85, b)[:, None]
    shade = ambient + (1 - ambient) * (scene.normals * light[:, None]).sum(-1).clamp_min(0)
    held = _cloth(draw, b)[:, None].expand(b, q, 3) * draw.uniform(0.85, 1, b, q, 1)
    color = torch.cat([albedo * shade[..., None] * draw.uniform(0.94, 1, b, p, 1), held], 1)
    index = which.flatten(1).clamp_min(0)[..., None].expand(-1, -1, 3)
    return z, color.gather(1, index).mT.reshape(b, 3, PIXELS, PIXELS)


def _body(
    draw: Draw, scene: HandScene, worn: Float[Tensor, "b 3 3"], scale: Float[Tensor, " b"]
) -> tuple[Float[Tensor, "b s s"], Float[Tensor, "b 3 s s"]]:
    """Depth and colour of the rest of the body, coarsely, with folds."""
    b, size = len(worn), PIXELS // COARSE
    z, which = render.splat_which(scene.body, scale / COARSE, size)
    hit = (which >= 0)[:, None].float()
    kind = scene.body_wear[which.clamp_min(0)].flatten(1)[..., None].expand(-1, -1, 3)
    color = worn.gather(1, kind).mT.reshape(b, 3, size, size) * hit
    color, share = (F.interpolate(x, size=PIXELS, mode="bilinear") for x in (color, hit))  # outlines without steps
    near = F.interpolate(-F.max_pool2d(-z[:, None], 3, 1, 1), size=PIXELS, mode="nearest")
    z = torch.where(share > 0.5, near, render.FAR)[:, 0]
    return z, color / share.clamp_min(0.1) * _folds(draw, b)


def _cloth_of(draw: Draw, worn: Float[Tensor, "b 3 3"], which: Int[Tensor, " b"]) -> Float[Tensor, "b 3 s s"]:
    """A piece of what each wears."""
    color = worn[torch.arange(len(worn)), which.clamp_min(0)]
    return color[..., None, None] * _folds(draw, len(worn))


def _folds(draw: Draw, b: int) -> Float[Tensor, "b 1 s s"]:
    return 1 - 0.35 * (_field(draw, b, 12).sigmoid() * draw.uniform(0, 1, b, 1, 1))[:, None]


def _creases(draw: Draw, z: Float[Tensor, "b s s"], distance: Float[Tensor, " b"]) -> Float[Tensor, "b s s"]:
    """Shade of what lies a little deeper than its surroundings, between fingers: little of the room's light gets there.
    z: depth of the hand.
    """
    b = len(z)
    near = z.sub(distance[:, None, None]).clamp(-_REACH, _REACH)[:, None]
    around = F.avg_pool2d(near, 5, 1, 2, count_include_pad=False)
    front = -F.max_pool2d(-near, 5, 1, 2)
    deep = ((near - around) / 0.012).clamp(0, 1) * ((_CREASE - (near - front)) / 0.02).clamp(0, 1)
    return (1 - draw.uniform(0, 0.6, b, 1, 1, 1) * deep)[:, 0]


def _surface(draw: Draw, b: int) -> Float[Tensor, "b 3 s s"]:
    """Walls and furniture: one or two plain colours with a straight edge in between, more or less spotted."""
    one, other = _cloth(draw, b), _cloth(draw, b)
    step = torch.linspace(-1, 1, PIXELS)
    angle = draw.uniform(0, 2 * torch.pi, b, 1, 1)
    beyond = angle.cos() * step + angle.sin() * step[:, None] > draw.uniform(-0.9, 2.5, b, 1, 1)
    color = torch.where(beyond[:, None], other[..., None, None], one[..., None, None])
    spots = _field(draw, b, 18) * draw.uniform(0, 0.12, b, 1, 1) * draw.chance(0.6, b)[:, None, None]
    return color * (1 + spots[:, None])


def _field(draw: Draw, b: int, cells: int) -> Float[Tensor, "b s s"]:
    """Smooth and random."""
    return F.interpolate(draw.normal(b, 1, cells, cells), size=PIXELS, mode="bilinear")[:, 0]


def _skin(draw: Draw, b: int) -> Float[Tensor, "b 3"]:
    tone = torch.lerp(torch.tensor(_SKIN[0]), torch.tensor(_SKIN[1]), draw.uniform(0, 1, b, 1))
    return (tone * draw.lognormal(0.06, b, 3)).clamp_max(1)


def _cloth(draw: Draw, b: int) -> Float[Tensor, "b 3"]:
    """A random colour for each."""
    grey, tint = draw.uniform(0.15, 0.95, b, 1), draw.uniform(0.05, 0.95, b, 3)
    bright = torch.lerp(grey.expand(b, 3), tint, draw.uniform(0, 0.9, b, 1))
    dark = draw.uniform(0.03, 0.14, b, 1) + 0.03 * draw.uniform(0, 1, b, 3)
    return torch.where(draw.chance(0.25, b)[:, None], dark, bright)


def _blurred(image: Float[Tensor, "b 3 s s"], sigma: Float[Tensor, " b"]) -> Float[Tensor, "b 3 s s"]:
    """Each with its own Gaussian, sigma in pixels."""
    b = len(image)
    taps = torch.arange(_TAPS) - _TAPS // 2
    kernel = torch.exp(-0.5 * (taps / sigma[:, None]) ** 2)
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(3, 0)[:, None]
    flat = F.pad(image.reshape(1, b * 3, *image.shape[2:]), (_TAPS // 2,) * 4, mode="replicate")
    out = F.conv2d(F.conv2d(flat, kernel[:, :, None], groups=3 * b), kernel[..., None], groups=3 * b)
    return out.reshape_as(image)
