"""From motion-capture files (BVH) to postures of the simulated skeleton.

Retargeting looks at where the joints are, not at the file's own joint rotations, so files with any rest pose can be
used; only the head's turn against the chest comes from the file's rotations.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.errors import RecordingError, UnderstudyError
from understudy.synthetic.bvh_file import Bvh, Frames, read_bvh
from understudy.synthetic.segments import SEGMENT, SEGMENTS

__all__ = ["Bvh", "load_folder", "map_joints", "read_bvh", "retarget"]

Array = np.ndarray

# Names after dropping prefixes, separators and case. Sided ones are written with the side cut off.
_CENTRAL: Final = {
    "hips": ("hips", "hip", "pelvis", "root", "mhip", "bhips"),
    "spine": ("spine", "lowerback", "spine1", "torso", "abdomen", "spinelower", "waist", "chest"),
    "chest": ("spine3", "chest4", "chest3", "spine2", "chest2", "upperchest", "spine1", "chest", "thorax",
              "spineupper", "spine"),
    "neck": ("neck", "lowerneck", "neck1", "neck01"),
    "head": ("head",),
}  # fmt: skip
_SIDED: Final = {
    "thigh": ("upleg", "hip", "thigh", "upperleg", "legupper", "femur"),
    "shin": ("knee", "leg", "shin", "lowleg", "lowerleg", "calf", "leglower", "tibia"),
    "foot": ("ankle", "foot"),
    "toe": ("toe", "toebase", "toes", "ball", "forefoot", "foot"),
    "clavicle": ("collar", "clavicle", "shoulder", "collarbone"),
    "upper_arm": ("arm", "uparm", "upperarm", "shoulder", "armupper", "humerus"),
    "forearm": ("elbow", "forearm", "lowarm", "lowerarm", "armlower", "radius"),
    "hand": ("wrist", "hand"),
    "middle": ("handmiddle1", "middle1", "finger2", "fingers", "middle01", "handindex1", "finger1", "hand"),
    "index": ("handindex1", "index1", "handindex", "index01", "indexproximal"),
    "pinky": ("handpinky1", "pinky1", "handring1", "ring1", "handpinky", "pinky01", "littleproximal"),
    "thumb": ("thumb", "handthumb1", "handthumb", "thumb1", "thumb01", "handthumb2"),
}  # fmt: skip
REQUIRED: Final = ("thigh", "shin", "foot", "upper_arm", "forearm", "hand")


def _key(name: str) -> tuple[str, str]:
    """Joint name -> (side 'l', 'r' or '', the rest), lower case without prefix and separators."""
    base = re.split(r"[:|]", name)[-1].strip()
    base = re.sub(r"^(mixamorig\d*|bip0?01|bip\d*|def|org|jnt|b|m|f)[ _.\-]+", "", base, flags=re.I)
    base = re.sub(r"^mixamorig\d*", "", base, flags=re.I)
    words = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", base)
    words = re.sub(r"([A-Z])([A-Z][a-z])", r"\1 \2", words)
    parts = [p.lower() for p in re.split(r"[ _.\-]+", words) if p]
    side = ""
    for where in (0, -1):
        if parts and parts[where] in ("l", "r", "left", "right"):
            side = parts.pop(where)[0]
            break
    rest = "".join(parts)
    for long in ("left", "right"):
        if not side and rest.startswith(long):
            side, rest = long[0], rest[len(long) :]
        elif not side and rest.endswith(long):
            side, rest = long[0], rest[: -len(long)]
    if (
        not side
        and rest[:1] in ("l", "r")
        and rest[1:] in ("hand", "thumb", "fingers", "hip", "foot", "toe", "knee", "wrist")
    ):
        side, rest = rest[0], rest[1:]
    return side, rest


def map_joints(bvh: Bvh) -> dict[str, int]:
    """Our joint -> index in the file, e.g. `left_thigh` (the hip joint), `head`, `right_toe`.

    The error names what was not found and lists the file's joints.
    """
    keys: dict[tuple[str, str], int] = {}
    for i, name in enumerate(bvh.names):
        keys.setdefault(_key(name), i)
    out: dict[str, int] = {}
    for side, letter in (("left", "l"), ("right", "r")):
        for part, choices in _SIDED.items():
            taken = {v for k, v in out.items() if k.startswith(side)}
            hits = [keys[letter, c] for c in choices if (letter, c) in keys]
            if part == "clavicle" and ("l", "collar") not in keys and ("l", "clavicle") not in keys:
                # 'shoulder' is the collar bone where there is an '(upper) arm' too, else the upper arm
                arms = any((letter, c) in keys for c in ("arm", "uparm", "upperarm", "humerus"))
                hits = hits if arms else []
            hits = [h for h in hits if h not in taken]
            if hits:
                out[f"{side}_{part}"] = hits[0]
    for part, choices in _CENTRAL.items():
        for choice in choices:
            if ("", choice) in keys:
                out[part] = keys["", choice]
                break
    missing = [f"{side}_{part}" for part in REQUIRED for side in ("left", "right") if f"{side}_{part}" not in out]
    if missing:
        raise UnderstudyError(
            f"joints not found: {', '.join(missing)}; the file's joints are: {', '.join(bvh.names)[:1500]}"
        )
    return out


def _unit(v: Array) -> Array:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)


def _axes(first: Array, second: Array, which: str) -> Array:
    """Rotation with one column along `first` and another along the part of `second` square to it; 'xz': x, then z."""
    a = _unit(first)
    b = _unit(second - a * (a * second).sum(-1, keepdims=True))
    i, j = ("xyz".index(c) for c in which)
    k = 3 - i - j
    out = np.empty((*a.shape, 3))
    out[..., i], out[..., j] = a, b
    c = np.cross(a, b)
    out[..., k] = c if (i, j) in ((0, 1), (1, 2), (2, 0)) else -c
    return out


def _swing(a: Array, b: Array) -> Array:
    """Smallest rotation that takes unit vectors `a` to `b`."""
    v, c = np.cross(a, b), (a * b).sum(-1)[..., None, None]
    k = np.zeros((*v.shape, 3))
    k[..., 0, 1], k[..., 0, 2], k[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    k = k - np.swapaxes(k, -1, -2)
    return np.eye(3) + k + k @ k / np.maximum(1 + c, 1e-4)


def _half(a: Array, b: Array, share: float) -> Array:
    """Between two rotations that are not opposite."""
    mixed = (1 - share) * a + share * b
    u, _, vt = np.linalg.svd(mixed)
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def _trunk(at: dict[str, Array]) -> tuple[Array, Array]:
    """Pelvis and chest frames (x left, z up the spine) from hips, shoulders and the spine."""
    hips = (at["left_thigh"] + at["right_thigh"]) / 2
    shoulders = (at["left_upper_arm"] + at["right_upper_arm"]) / 2
    middle = at.get("chest", (hips + shoulders) / 2)
    whole = shoulders - hips
    low, high = middle - hips, shoulders - middle
    long = np.linalg.norm(whole, axis=-1, keepdims=True)

    def sure(part: Array) -> Array:  # too short a part says nothing
        share = np.clip(np.linalg.norm(part, axis=-1, keepdims=True) / long / 0.3, 0, 1)
        return share * _unit(part) + (1 - share) * _unit(whole)

    pelvis = _axes(at["left_thigh"] - at["right_thigh"], sure(low), "xz")
    chest = _axes(at["left_upper_arm"] - at["right_upper_arm"], sure(high), "xz")
    return pelvis, chest


def _upright(bvh: Bvh, joints: dict[str, int], world: Array) -> Array:
    """Rotation from the file's world to z up: which axis goes from the feet to the head, in the motion and at rest."""
    top = joints.get("head", joints["left_upper_arm"])
    rest = Bvh(bvh.names, bvh.parents, bvh.offsets, ((),) * len(bvh.names), np.zeros((1, 0)), 1.0).positions()[0]

    def up(points: Array) -> Array:
        return points[..., top, :] - (points[..., joints["left_foot"], :] + points[..., joints["right_foot"], :]) / 2

    tall = _unit(up(rest))
    votes = _unit(up(world)).mean(0) + 0.3 * tall
    if abs(votes[2]) > abs(votes[1]) and abs(votes[2]) > abs(votes[0]):
        return np.eye(3) if votes[2] > 0 else np.diag([1.0, -1.0, -1.0])
    if abs(votes[1]) >= abs(votes[0]):
        sign = np.sign(votes[1])
        return np.array([[1.0, 0, 0], [0, 0, -sign], [0, sign, 0]])
    sign = np.sign(votes[0])
    return np.array([[0, 0, -sign], [0, 1.0, 0], [sign, 0, 0]])


def retarget(bvh: Bvh, frame_indices: Frames = None) -> Float[np.ndarray, "f 21 3 3"]:
    """Postures of our skeleton: absolute segment rotations in the body frame; every frame faces -y.

    Directions of limbs come from the joints' positions, hinges from the bends of elbow and knee (a straight limb takes
    its neutral hinge). Joints that the file has not (toes, fingers, collar bones) follow their parents.
    """
    joints = map_joints(bvh)
    world, turns = bvh.solve(frame_indices)
    if not len(world):
        return np.zeros((0, len(SEGMENTS), 3, 3), np.float32)
    lift = _upright(bvh, joints, world)
    world = world @ lift.T
    turns = lift @ turns
    at = {name: world[:, i] for name, i in joints.items()}
    pelvis, chest = _trunk(at)
    # heading: the hips' and shoulders' left, level
    left = pelvis[..., 0] + 0.3 * chest[..., 0]
    yaw = np.arctan2(left[:, 1], left[:, 0])
    c, s, zero, one = np.cos(-yaw), np.sin(-yaw), np.zeros_like(yaw), np.ones_like(yaw)
    face = np.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).reshape(-1, 3, 3)
    at = {name: (face @ p[..., None])[..., 0] for name, p in at.items()}
    pelvis, chest, turns = face @ pelvis, face @ chest, face[:, None] @ turns

    out = np.empty((len(world), len(SEGMENTS), 3, 3))
    out[:, SEGMENT["pelvis"]], out[:, SEGMENT["chest"]] = pelvis, chest
    out[:, SEGMENT["abdomen"]] = _half(pelvis, chest, 0.45)
    head = _head(bvh, joints, turns, chest)
    out[:, SEGMENT["head"]] = head
    out[:, SEGMENT["neck"]] = _half(chest, head, 0.45)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        _leg(out, at, side)
        _arm(out, at, side, sign)
    return out.astype(np.float32)


def _head(bvh: Bvh, joints: dict[str, int], turns: Array, chest: Array) -> Array:
    """The head's frame: how far the file's head joint is turned against its chest joint since the rest pose."""
    if "head" not in joints:
        return chest
    base = joints.get("chest", joints.get("neck", joints.get("hips", 0)))
    relative = np.swapaxes(turns[:, base], -1, -2) @ turns[:, joints["head"]]
    # in the chest's axes; the file's own axes at rest are those of the trunk at rest
    rest = Bvh(bvh.names, bvh.parents, bvh.offsets, ((),) * len(bvh.names), np.zeros((1, 0)), 1.0).positions()[0]
    _, frame = _trunk({name: rest[None, i] for name, i in joints.items()})
    if not np.isfinite(frame).all():
        return chest
    local = frame[0].T @ relative @ frame[0]
    angle = np.degrees(np.arccos(np.clip((np.trace(local, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))
    if np.median(angle) > 60:  # the rest pose is not upright: say nothing
        return chest
    limited = np.minimum(1.0, 80 / np.maximum(angle, 1e-6))
    return chest @ _scaled(local, limited)


def _scaled(rotation: Array, share: Array) -> Array:
    """Rotations shortened to a share of their angle."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(Rotation.from_matrix(rotation).as_rotvec() * share[:, None]).as_matrix()


def _hinge(first: Array, second: Array, neutral: Array) -> Array:
    """Axis of a hinge whose bones point along `first` and `second`: the neutral one where they are nearly in line."""
    bend = np.cross(first, second)
    sine = np.linalg.norm(bend, axis=-1, keepdims=True)
    share = np.clip((sine - 0.05) / 0.2, 0, 1)
    return share * bend / np.maximum(sine, 1e-9) + (1 - share) * neutral


def _leg(out: Array, at: dict[str, Array], side: str) -> None:
    first = _unit(at[f"{side}_shin"] - at[f"{side}_thigh"])
    second = _unit(at[f"{side}_foot"] - at[f"{side}_shin"])
    pelvis = out[:, SEGMENT["pelvis"]]
    neutral = (_swing(-pelvis[..., 2], first) @ pelvis)[..., 0]
    if f"{side}_toe" in at:  # the foot tells which way the knee faces
        sole = at[f"{side}_toe"] - at[f"{side}_foot"]
        ahead = np.cross(sole, second)  # forward x down = right-handed left
        clear = np.linalg.norm(ahead, axis=-1, keepdims=True) > 0.3 * np.linalg.norm(sole, axis=-1, keepdims=True)
        neutral = np.where(clear, _unit(ahead), neutral)
    hinge = _hinge(first, second, neutral)
    hinge = np.where((hinge * neutral).sum(-1, keepdims=True) < -0.3, neutral, hinge)  # hyperextended: noise
    thigh, shin = _axes(-first, hinge, "zx"), _axes(-second, hinge, "zx")
    out[:, SEGMENT[f"{side}_thigh"]], out[:, SEGMENT[f"{side}_shin"]] = thigh, shin
    foot = shin
    if f"{side}_toe" in at:
        # the ankle-to-ball line falls 34 degrees below the sole's level
        foot = _axes(-(at[f"{side}_toe"] - at[f"{side}_foot"]), shin[..., 0], "yx")
        c, s = np.cos(BALL_DIP), np.sin(BALL_DIP)
        foot = foot @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    out[:, SEGMENT[f"{side}_foot"]] = foot


BALL_DIP: Final = 0.53
"""Radians by which the line from ankle to the ball of the foot falls below the sole's level."""


def _arm(out: Array, at: dict[str, Array], side: str, sign: float) -> None:
    chest = out[:, SEGMENT["chest"]]
    clavicle = chest
    if f"{side}_clavicle" in at:
        line = np.swapaxes(chest, -1, -2) @ _unit(at[f"{side}_upper_arm"] - at[f"{side}_clavicle"])[..., None]
        line = line[..., 0]
        usual = _unit(line.mean(0))
        turn = _swing(np.broadcast_to(usual, line.shape), line)
        clavicle = chest @ turn
    out[:, SEGMENT[f"{side}_clavicle"]] = clavicle
    first = _unit(at[f"{side}_forearm"] - at[f"{side}_upper_arm"])
    second = _unit(at[f"{side}_hand"] - at[f"{side}_forearm"])
    neutral = (_swing(sign * chest[..., 0], first) @ chest)[..., 2]
    # seen from above, the right forearm bends from -x to -y: about +z; the left one about -z
    hinge = -sign * _hinge(first, second, -sign * neutral)
    upper, fore = _axes(sign * first, hinge, "xz"), _axes(sign * second, hinge, "xz")
    out[:, SEGMENT[f"{side}_upper_arm"]] = upper
    hand = fore
    along = at.get(f"{side}_middle", at.get(f"{side}_index"))
    along = second if along is None else _unit(along - at[f"{side}_hand"])
    across = None
    if f"{side}_index" in at and f"{side}_pinky" in at:
        across = at[f"{side}_index"] - at[f"{side}_pinky"]
    elif f"{side}_thumb" in at:
        across = at[f"{side}_thumb"] - at[f"{side}_hand"]
    if across is not None:  # the thumb's side is -y
        square = across - along * (across * along).sum(-1, keepdims=True)
        clear = np.linalg.norm(square, axis=-1, keepdims=True) > 0.15 * np.linalg.norm(across, axis=-1, keepdims=True)
        hand = np.where(clear[..., None], _axes(sign * along, -square, "xy"), fore)
    elif f"{side}_middle" in at:
        hand = _axes(sign * along, fore[..., 2], "xz")
    out[:, SEGMENT[f"{side}_hand"]] = out[:, SEGMENT[f"{side}_fingers"]] = hand
    # the forearm takes half of the hand's roll
    relative = np.swapaxes(fore, -1, -2) @ hand
    roll = np.arctan2(relative[:, 2, 1] - relative[:, 1, 2], relative[:, 1, 1] + relative[:, 2, 2])
    half = 0.5 * np.clip(roll, -1.6, 1.6)
    c, s, zero, one = np.cos(half), np.sin(half), np.zeros_like(half), np.ones_like(half)
    out[:, SEGMENT[f"{side}_forearm"]] = fore @ np.stack([one, zero, zero, zero, c, -s, zero, s, c], -1).reshape(
        -1, 3, 3
    )


def load_folder(folder: str | Path, every_s: float = 0.1) -> Float[np.ndarray, "m 21 3 3"]:
    """Postures from all `*.bvh` files below a folder, one every `every_s` seconds.

    Damaged files are skipped, with a warning.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RecordingError(f"{folder}: is not a folder")
    if not every_s > 0:
        raise UnderstudyError(f"every_s must be above 0, got {every_s}")
    out = [np.zeros((0, len(SEGMENTS), 3, 3), np.float32)]
    for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() == ".bvh" and p.is_file()):
        try:
            bvh = read_bvh(path)
            out.append(retarget(bvh, slice(None, None, max(1, round(every_s / bvh.frame_time_s)))))
        except UnderstudyError as e:
            warnings.warn(f"{path} is skipped: {e}", stacklevel=2)
    return np.concatenate(out)
