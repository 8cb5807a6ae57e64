"""Ground truth: COCO-18 joints, visibility and palm normals in the colour camera's frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from bodies import Body
from layout import COLOR_K, COLOR_SIZE, FACE_JOINTS, Array, color_to_world
from numpy.typing import NDArray
from rig import palm_of
from sensor import Scene

LIMBS = {
    2: "upperarm01.R",
    3: "lowerarm01.R",
    4: "wrist.R",
    5: "upperarm01.L",
    6: "lowerarm01.L",
    7: "wrist.L",
    8: "upperleg01.R",
    9: "lowerleg01.R",
    10: "foot.R",
    11: "upperleg01.L",
    12: "lowerleg01.L",
    13: "foot.L",
}
FACE = {0: "nose", 14: "right_eye", 15: "left_eye", 16: "right_ear", 17: "left_ear"}
NOTE = (
    "Made, not measured. Limb joints are the rotation centres of the posed body's skeleton (anny 0.6.2: "
    "heads of upperarm01, lowerarm01, wrist, upperleg01, lowerleg01, foot), so bone lengths are constant. "
    "Nose, eyes and ears are anny's COCO key point regressor on the rest head (ears 8 mm further in), "
    "carried rigidly by the head bone; neck is the midpoint of the shoulders. Occluded: the first surface "
    "along the colour camera's ray to the joint is another object or person in front of it, or the "
    "person's own body or clothes more than 0.12 m (face joints 0.06 m, hips 0.15 m) nearer. Palm "
    "normals: cross(index MCP - wrist, pinky MCP - wrist), negated for the left hand."
)


def joints_world(body: Body, rot: Array, pos: Array) -> Array:
    """The 18 joints of a posed body."""
    out = np.zeros((18, 3))
    for j, label in LIMBS.items():
        out[j] = pos[body.bones.index(label)]
    head = body.bones.index("head")
    for j, label in FACE.items():
        place = body.coco[label].copy()
        if label.endswith("ear"):
            place[0] -= 0.008 * np.sign(place[0])  # from the surface of the ear to its inside
        out[j] = pos[head] + rot[head] @ (place - body.heads[head])
    out[1] = 0.5 * (out[2] + out[5])
    return out


def palms_world(body: Body, pos: Array) -> dict[str, tuple[Array, Array]]:
    """Centre and normal of both palms."""
    out = {}
    for side, name in (("L", "left"), ("R", "right")):
        wrist, index, pinky = (pos[body.bones.index(f"{b}.{side}")] for b in ("wrist", "finger2-1", "finger5-1"))
        out[name] = ((wrist + index + pinky) / 3, palm_of(index, pinky, wrist, side))
    return out


def project(points: Array) -> Array:
    """Colour pixels of points in the colour frame."""
    uvw = points @ COLOR_K.T
    return uvw[:, :2] / uvw[:, 2:]


def in_image(points: Array) -> NDArray[np.bool_]:
    """Before the camera and inside the colour image."""
    uv = project(points)
    size = np.array(COLOR_SIZE)
    return (points[:, 2] > 0.05) & (uv >= -0.5).all(1) & (uv < size - 0.5).all(1)


def person_truth(
    scene: Scene, owner: NDArray[np.int32], number: int, body: Body, rot: Array, pos: Array
) -> dict[str, Any]:
    """One person's entry of truth.json. `owner` tells each face's person, -1 for things."""
    to_world = color_to_world()
    world = joints_world(body, rot, pos)
    cam = (world - to_world[:3, 3]) @ to_world[:3, :3]
    cam = cam.round(5)
    cam[1] = (0.5 * (cam[2] + cam[5])).round(6)  # exactly, also as written
    reach, face, _ = scene.cast(to_world[:3, 3], world - to_world[:3, 3])
    distance = np.linalg.norm(world - to_world[:3, 3], axis=1)
    before = distance * (1.0 - reach)  # by how much the first surface is nearer than the joint
    own = (face >= 0) & (owner[np.maximum(face, 0)] == number)
    limit = np.full(18, 0.12)
    limit[list(FACE_JOINTS)] = 0.06
    limit[[8, 11]] = 0.15  # a hip's centre lies 0.13 m behind the clothes of a person seen from the front
    occluded = (face >= 0) & (reach > 0) & (before > np.where(own, limit, 0.0))
    hands = {}
    for name, (centre, normal) in palms_world(body, pos).items():
        centre_cam = (centre - to_world[:3, 3]) @ to_world[:3, :3]
        hands[name] = {
            "normal": [round(float(x), 5) for x in to_world[:3, :3].T @ normal],
            "in_view": bool(in_image(centre_cam[None])[0]),
        }
    return {
        "id": number,
        "keypoints": [[round(float(x), 6) for x in p] for p in cam],
        "in_view": [bool(b) for b in in_image(cam)],
        "occluded": [bool(b) for b in occluded],
        "hands": hands,
    }
