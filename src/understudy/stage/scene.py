"""The whole scene of one demonstration: furniture, room, person and markers, as one model of MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy.spatial.transform import Rotation

from understudy.demonstration.tasks import TASKS
from understudy.geometry import inverse
from understudy.objects.marker_setup import Marker
from understudy.stage.furniture import Furniture
from understudy.stage.markers import OBJECT, PLATE, mount, plate_image
from understudy.stage.mechanism import PART, add_furniture
from understudy.stage.palette import Palette, add_plate, furniture_materials
from understudy.stage.room import add_room

_LARGEST: Final = (2560, 1440)
"""of the pictures that are rendered, pixels"""


@runtime_checkable
class Piece(Protocol):
    """A part of a person's surface of one material: skin, hair, a shirt."""

    @property
    def name(self) -> str: ...
    @property
    def faces(self) -> Int[np.ndarray, "f 3"]: ...
    @property
    def color(self) -> Sequence[float] | np.ndarray: ...
    @property
    def texture(self) -> UInt8[np.ndarray, "h w 3"] | None: ...
    @property
    def uv(self) -> Float[np.ndarray, "v 2"] | None: ...


class Scene:
    """A compiled scene. `pose` sets what moves."""

    def __init__(
        self,
        furniture: Furniture,
        seed: int,
        pieces: Sequence[Piece] = (),
        vertices: Sequence[Float32[np.ndarray, "v 3"]] = (),
        markers: Sequence[Marker] = (),
    ):
        """vertices: of the pieces, at any moment. The room and all colours follow from the seed."""
        self.furniture, self.pieces, self.markers = furniture, tuple(pieces), tuple(markers)
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        spec.visual.global_.offwidth, spec.visual.global_.offheight = _LARGEST
        spec.visual.quality.shadowsize = 2048
        palette = Palette(spec, np.random.default_rng([seed, 71, TASKS.index(furniture.task)]))
        materials = furniture_materials(palette)
        add_furniture(spec, furniture, materials=materials)
        add_room(palette, furniture, materials)
        for piece, points in zip(self.pieces, vertices, strict=True):
            _add_skin(palette, piece, points)
        _add_markers(palette, markers, materials)
        # the region of shadows: beyond its rim a shadow map gives a moire pattern
        spec.stat.extent, spec.stat.center, spec.visual.map.shadowclip = 3.0, [-0.8, 0, 1.0], 2.0
        self.model = spec.compile()
        palette.write(self.model)
        self.data = mujoco.MjData(self.model)
        self._joint = self.model.joint(PART).qposadr[0]
        self.pose(0.0)

    def pose(
        self,
        q: float,
        vertices: Sequence[Float32[np.ndarray, "v 3"]] = (),
        carried: Mapping[str, Float[np.ndarray, "4 4"]] | None = None,
    ) -> None:
        """Moves the part to q, the person's surface to vertices (world, one array per piece), and the markers.

        carried: thing that carries markers (but for the part) -> its pose in the world.
        """
        model, data = self.model, self.data
        data.qpos[self._joint] = q
        for i, points in enumerate(vertices):
            start, count = model.skin_vertadr[i], model.skin_vertnum[i]
            if points.shape != (count, 3):
                raise ValueError(f"piece {i}: {points.shape} vertices, the scene was made with {count}")
            model.skin_vert[start : start + count] = points
        for name, T in (carried or {}).items():
            place = model.body(name).mocapid[0]
            data.mocap_pos[place] = T[:3, 3]
            data.mocap_quat[place] = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)


def _add_skin(palette: Palette, piece: Piece, points: Float32[np.ndarray, "v 3"]) -> None:
    """A skin that hangs on the world as a whole: its vertices are overwritten, its normals are MuJoCo's."""
    n, name = len(points), f"person_{piece.name}"
    options: dict[str, object] = {}
    if piece.texture is not None and piece.uv is not None:
        material = palette.add(name, np.ascontiguousarray(piece.texture), cube=False, shine=0.05)
        options["texcoord"] = np.asarray(piece.uv, np.float64).ravel()
    else:
        material = palette.plain(name, np.asarray(piece.color, np.float64), shine=0.05)
    palette.spec.add_skin(
        name=name,
        material=material,
        vert=np.asarray(points, np.float64).ravel(),
        face=np.asarray(piece.faces).ravel(),
        bodyname=["world"],
        bindpos=[0, 0, 0],
        bindquat=[1, 0, 0, 0],
        vertid=[list(range(n))],
        vertweight=[[1.0] * n],
        **options,
    )


def _add_markers(palette: Palette, markers: Sequence[Marker], materials: Mapping[str, str]) -> None:
    """Plates, rigidly on what carries them: the furniture's part, or a body that `Scene.pose` moves."""
    for on in sorted({marker.on for marker in markers}):
        if on == OBJECT:
            carrier = palette.spec.body(PART)
        else:
            carrier = palette.spec.worldbody.add_body(name=on, mocap=True)
            box = mount(on, markers)
            carrier.add_geom(
                name=box.name,
                type=mujoco.mjtGeom.mjGEOM_BOX,
                material=materials[box.material],
                pos=box.T_frame_box[:3, 3],
                size=box.half_m,
                contype=0,
                conaffinity=0,
                mass=0.01,
            )
        for marker in (m for m in markers if m.on == on):
            name, image = f"marker_{marker.id}", plate_image(marker.id)
            add_plate(palette, carrier, name, image, marker.size_m * PLATE, inverse(marker.T_marker_frame))
