"""A person who opens a piece of furniture: what is seen of them over time, and the truth about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32

from understudy.demonstration.demonstration import Segments
from understudy.errors import UnderstudyError
from understudy.skeleton import JOINT
from understudy.stage.appearance import draw_looks, dress
from understudy.stage.appearance_pieces import Garment, Piece
from understudy.stage.body import SIDES, Body, draw_body
from understudy.stage.furniture import Furniture
from understudy.stage.kinematics import unit
from understudy.stage.kinematics_body import SPINE
from understudy.stage.motion import Motion, plan_motion

__all__ = ["Performance", "Piece", "perform"]


@dataclass(frozen=True, eq=False)
class Performance:
    """One person's demonstration, exactly. World: z up, the floor at z = 0; the furniture's frame."""

    times_s: Float[np.ndarray, " t"]
    q: Float[np.ndarray, " t"]
    """position of the furniture's part, radians or metres"""
    segments: Segments
    """grasp: the hand is in place and its fingers are closed; release: they begin to open"""
    acting: str
    """left or right"""
    pieces: tuple[Piece, ...]
    joints: Float[np.ndarray, "t 18 3"]
    """COCO-18 of the rig that moves the mesh, as `synthetic.body_anny` defines them"""
    T_world_hand: Mapping[str, Float[np.ndarray, "t 4 4"]]
    """side -> origin midway between wrist and middle knuckle, x to the fingers, z out of the palm"""
    torso_xy_yaw: Float[np.ndarray, "t 3"]
    """point of the floor below the middle of shoulders and hips; yaw of the chest, unwrapped"""
    T_world_torso: Float[np.ndarray, "t 4 4"]
    """origin midway between the middles of shoulders and hips, z from hips to shoulders, x with the chest's heading"""
    T_handle_hand: Float[np.ndarray, "4 4"]
    """how the acting hand holds the handle"""
    R_world_bone: Float[np.ndarray, "t b 3 3"]
    """from the rest pose"""
    p_world_bone: Float[np.ndarray, "t b 3"]
    motion: Motion
    """where it was sampled from"""
    _garments: tuple[Garment, ...]

    def __len__(self) -> int:
        return len(self.times_s)

    def vertices(self, i: int) -> list[Float32[np.ndarray, "v 3"]]:
        """World positions of every piece's vertices at sample i (linear blend skinning)."""
        R, heads = self.R_world_bone[i], self.motion.skeleton.heads
        shift = self.p_world_bone[i] - np.einsum("bij,bj->bi", R, heads)
        bones = np.concatenate([R.reshape(-1, 9), shift], 1).astype(np.float32)
        out = []
        for garment in self._garments:
            blend = garment.weights @ bones
            points = np.einsum("vij,vj->vi", blend[:, :9].reshape(-1, 3, 3), garment.vertices) + blend[:, 9:]
            out.append(points.astype(np.float32))
        return out

    def carriers(self, i: int) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Poses in the world, at sample i, of what markers are put on: the acting hand and the torso."""
        return {"hand": self.T_world_hand[self.acting][i], "torso": self.T_world_torso[i]}


@lru_cache(maxsize=4)
def _dressed(seed: int) -> tuple[Body, tuple[Garment, ...]]:
    body = draw_body(seed)
    rng = np.random.default_rng([seed, 3])
    garments = dress(body, draw_looks(rng, body.female), rng)
    light = [Garment(g.piece, g.vertices.astype(np.float32), g.weights.astype(np.float32)) for g in garments]
    return body, tuple(light)


def perform(furniture: Furniture, seed: int, fps: float = 10.0) -> Performance:
    """A random adult opens the furniture. Deterministic; a second or two once anny is loaded.

    Raises UnderstudyError (frame rate) and MissingExtraError (anny or torch is not installed).
    """
    if not 1 <= fps <= 240:
        raise UnderstudyError(f"fps {fps}: must be between 1 and 240")
    body, garments = _dressed(seed)
    return performance_of(plan_motion(body.skeleton, furniture, seed), fps, garments)


def performance_of(motion: Motion, fps: float, garments: tuple[Garment, ...] = ()) -> Performance:
    """A planned motion, sampled; without garments there is nothing to see, but all truth."""
    skeleton, clock = motion.skeleton, motion.clock
    times = np.arange(int(clock.end * fps) + 1) / fps
    R, p = motion.at(times)
    joints = skeleton.joints(R, p)
    chest = R[:, skeleton.bone(SPINE[-1]), :, 0]
    yaw = np.unwrap(np.arctan2(chest[:, 1], chest[:, 0]))
    T_torso = _torso(joints, yaw)
    grasp, release = (int(np.searchsorted(times, moment - 1e-9)) for moment in (clock.grasp, clock.release))
    return Performance(
        times,
        motion.q(times),
        Segments(grasp, release),
        motion.acting,
        tuple(g.piece for g in garments),
        joints,
        {side: skeleton.hand(R, p, side) for side in SIDES},
        np.column_stack([T_torso[:, :2, 3], yaw]),
        T_torso,
        motion.grip.T_handle_hand,
        R,
        p,
        motion,
        garments,
    )


def _torso(joints: Float[np.ndarray, "t 18 3"], yaw: Float[np.ndarray, " t"]) -> Float[np.ndarray, "t 4 4"]:
    """Frame of the torso: from the midpoint of the hips to that of the shoulders is z; x has the chest's heading, which
    that of the shoulders' line is not while an arm reaches.
    """
    shoulders = (joints[:, JOINT["left_shoulder"]] + joints[:, JOINT["right_shoulder"]]) / 2
    hips = (joints[:, JOINT["left_hip"]] + joints[:, JOINT["right_hip"]]) / 2
    z = unit(shoulders - hips)
    level = np.column_stack([np.cos(yaw), np.sin(yaw)])
    x = unit(np.column_stack([level, -np.sum(level * z[:, :2], axis=1) / z[:, 2]]))
    T = np.tile(np.eye(4), (len(joints), 1, 1))
    T[:, :3, :3] = np.stack([x, np.cross(z, x), z], -1)
    T[:, :3, 3] = (hips + shoulders) / 2
    return T
