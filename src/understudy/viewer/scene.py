"""The 3D scene: cloud, skeletons, labels, camera, floor. Its world is the colour camera's frame, metres."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from understudy.camera import Camera
from understudy.floor import find_floor
from understudy.hand_overlay import PALM_ARROW_M, palm_middle, sure
from understudy.overlay import Rgb, bone_color, describe, joint_color, person_color
from understudy.skeleton import BONES, FACE, HAND_BONES, JOINT
from understudy.types import INFERRED, Person
from understudy.viewer.cloud import Cloud, near_people, thin
from understudy.viewer.results import Moment

JOINT_RADIUS_M = 0.028
FACE_RADIUS_M = 0.016
BONE_WIDTH_M = 0.025
HAND_BONE_WIDTH_M = 0.007
ARROW = (225, 0, 120)
"""RGB of palms' arrows: white, as in pictures, is lost on the white page"""
SURE_ARROW = {"shaft_radius": 0.009, "head_radius": 0.022, "head_length": 0.045}
FAINT_ARROW = {"shaft_radius": 0.003, "head_radius": 0.01, "head_length": 0.03}
"""metres; of palms whose confidence is low"""
FOV = float(np.deg2rad(45))
RIGHT = np.array([1.0, 0.0, 0.0])
FROM = np.array([0.5, 0.42, 0.75])
"""direction of the first view's place from the people: to the right, up, towards the camera"""
SEE_THROUGH_M = 0.014
"""distance of the points of people when they are to be seen through"""
PEOPLE_SIZE = 0.6
"""size of people's points over that of the others"""
PALE = 0.55
"""share of white in what is inferred"""
GROUPS = ("cloud", "skeletons", "labels", "camera")
"""what can be shown and hidden"""


def pale(color: Rgb) -> Rgb:
    r, g, b = (round(c + PALE * (255 - c)) for c in color)
    return r, g, b


class Scene:
    """Draws moments on a viser server; nodes of the same name replace each other."""

    def __init__(self, server: Any, camera: Camera, first: Moment):
        """`first` decides the view: the first frame with people."""
        self._api = server.scene
        self._camera = camera
        self._sphere = _icosahedron()
        self.groups = {name: self._api.add_frame(f"/{name}", show_axes=False) for name in GROUPS}
        self.nodes: dict[str, Any] = {}
        """viser's handles of what changes with the frame, by name"""
        self._clouds: dict[str, Any] = {}
        self._see_through = True
        spacing = first.cloud.spacing_m if first.cloud is not None else 0.0
        self.point_size_m = float(np.clip(round(0.45 * spacing, 3), 0.007, 0.02))
        self._set_up(server, first)

    def _set_up(self, server: Any, first: Moment) -> None:
        """Up, floor, and a first view from above and aside on all the people."""
        people = first.lifted
        floor = find_floor(first.cloud.points if first.cloud is not None else None, people)
        self._up = floor.up
        self._api.set_up_direction(tuple(floor.up))
        joints = np.concatenate([p.keypoints for p in people]) if people else np.array([[0.0, 0.0, 2.5]])
        joints = joints[np.isfinite(joints).all(axis=1)]
        centre = (joints.min(axis=0) + joints.max(axis=0)) / 2
        self._api.add_grid(
            "/floor",
            10.0,
            10.0,
            plane="xz",
            cell_size=0.5,
            section_size=1.0,
            wxyz=tuple(floor.wxyz()),
            position=tuple(floor.below(centre)),
            shadow_opacity=0.0,
        )
        view = server.initial_camera
        view.position = tuple(view_point(joints, centre, floor.up))
        view.look_at = tuple(centre)
        view.fov = FOV

    def visible(self, group: str, shown: bool) -> None:
        """Shows or hides one of `GROUPS`."""
        self.groups[group].visible = shown

    def set_point_size(self, metres: float) -> None:
        self.point_size_m = metres
        for name, node in self._clouds.items():
            node.point_size = metres * (1.0 if name == "room" else PEOPLE_SIZE)

    def see_through(self, on: bool) -> None:
        """Whether people are drawn with few points, so that their skeletons show."""
        self._see_through = on
        if "people_dense" in self._clouds:
            self._clouds["people_dense"].visible = not on

    def draw(self, moment: Moment) -> None:
        """Replaces what is shown. Call within `server.atomic()`."""
        before, self.nodes, self._clouds = self.nodes, {}, {}
        try:
            if moment.cloud is not None:
                self._draw_cloud(moment.cloud, moment.lifted)
            for number, person in enumerate(moment.lifted):  # not the id: nothing makes ids differ within a frame
                self._draw_person(person, number)
            self._draw_camera(moment)
        finally:
            for name in before.keys() - self.nodes.keys():
                before[name].remove()

    def _draw_cloud(self, cloud: Cloud, people: tuple[Person, ...]) -> None:
        """People in two parts: few small points, through which their skeletons show, and the others."""
        theirs = near_people(cloud.points, people)
        sparse = np.zeros(len(cloud), dtype=bool)
        sparse[np.flatnonzero(theirs)[thin(cloud.points[theirs], cell=SEE_THROUGH_M)[0]]] = True
        for name, chosen in (("room", ~theirs), ("people", sparse), ("people_dense", theirs & ~sparse)):
            if chosen.any():
                node = self._api.add_point_cloud(
                    f"/cloud/{name}",
                    cloud.points[chosen],
                    cloud.colors[chosen],
                    point_size=self.point_size_m * (1.0 if name == "room" else PEOPLE_SIZE),
                    point_shape="circle",
                    point_shading="flat",
                    precision="float32",
                    visible=name != "people_dense" or not self._see_through,
                )
                self._clouds[name] = self._keep(node)

    def _draw_person(self, person: Person, number: int) -> None:
        where, color = f"/skeletons/{number}", person_color(person.id)
        known = np.isfinite(person.keypoints).all(axis=1)
        inferred = [s == INFERRED for s in person.source]
        bones = [b for b in BONES if known[list(b)].all()]
        if bones:
            colors = [[shade(bone_color(b, color), inferred[end]) for end in b] for b in bones]
            self._keep(
                self._api.add_line_segments(
                    f"{where}/bones",
                    person.keypoints[np.array(bones)].astype(np.float32),
                    np.array(colors, np.uint8),
                    thickness=BONE_WIDTH_M,
                )
            )
        rows = np.flatnonzero(known)
        radius = np.where(np.isin(rows, FACE), FACE_RADIUS_M, JOINT_RADIUS_M)
        self._keep(
            self._api.add_batched_meshes_simple(
                f"{where}/joints",
                *self._sphere,
                np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1)),
                person.keypoints[rows],
                batched_scales=radius.astype(np.float32),
                batched_colors=np.array([shade(joint_color(int(r), color), inferred[r]) for r in rows], np.uint8),
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
        )
        self._draw_palms(person, where)
        top = person.keypoints[rows[np.argmax(person.keypoints[rows] @ self._up)]] + 0.16 * self._up
        self._keep(
            self._api.add_label(f"/labels/{number}", describe(person), position=tuple(top), anchor="bottom-center")
        )

    def _draw_palms(self, person: Person, where: str) -> None:
        """Arrows out of the palms, and the hands' bones."""
        for side, palm in person.hands.items():
            if palm is None:
                continue
            middle = palm_middle(person, side)
            if middle is not None:
                arrow = np.stack([middle, middle + PALM_ARROW_M * palm.normal])[None]
                color, sizes = (ARROW, SURE_ARROW) if sure(palm) else (pale(ARROW), FAINT_ARROW)
                self._keep(self._api.add_arrows(f"{where}/{side}_palm", arrow, color, **sizes))
            if palm.keypoints is not None:
                known = np.isfinite(palm.keypoints).all(axis=1)
                bones = [b for b in HAND_BONES if known[list(b)].all()]
                if bones:
                    color = joint_color(JOINT[f"{side}_wrist"], person_color(person.id))
                    self._keep(
                        self._api.add_line_segments(
                            f"{where}/{side}_hand",
                            palm.keypoints[np.array(bones)].astype(np.float32),
                            np.tile(np.array(shade(color, not sure(palm)), np.uint8), (len(bones), 2, 1)),
                            thickness=HAND_BONE_WIDTH_M,
                        )
                    )

    def _draw_camera(self, moment: Moment) -> None:
        camera = self._camera
        self._keep(
            self._api.add_camera_frustum(
                "/camera/frustum",
                fov=float(2 * np.arctan2(camera.height / 2, camera.fy)),
                aspect=camera.width / camera.height,
                scale=0.25,
                thickness=0.008,
                image=moment.photo,
                format="jpeg",
            )
        )

    def _keep(self, node: Any) -> Any:
        self.nodes[node.name] = node
        return node


def view_point(
    points: Float[np.ndarray, "n 3"], centre: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Where to stand to see all points when looking at the centre from `FROM`: as near as they fit, with a margin."""
    back = FROM[0] * RIGHT + FROM[1] * up + FROM[2] * np.cross(RIGHT, up)
    back /= np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    off = points - centre
    side = np.maximum(np.abs(off @ right) + 0.3, np.abs(off @ np.cross(back, right)) + 0.35)
    return centre + back * max(1.5, float(np.max(side / np.tan(FOV / 2) + off @ back)))


def shade(color: Rgb, inferred: bool) -> list[float]:
    """The colour as viser takes it for lines and batched meshes: linear light (elsewhere it takes sRGB), 0 ... 255."""
    rgb = np.array(pale(color) if inferred else color) / 255
    return (255 * np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)).tolist()


def _icosahedron() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (unit radius) and faces of a small round ball."""
    import trimesh  # comes with viser

    ball = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(ball.vertices), np.asarray(ball.faces)
