"""Renders the colour frames with Blender (Cycles on the CPU). Run by make_sample.py in its own process.

usage: render.py WORK OUT_DIR SAMPLES FRAME [FRAME ...]; reads WORK/scene.npz, writes PNG files.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np
from layout import COLOR_F, COLOR_SIZE, SEED, color_to_world
from materials import material


def add_mesh(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    mat: str,
    color: np.ndarray,
    rest: np.ndarray | None,
    st: np.ndarray | None,
    smooth: bool,
) -> bpy.types.Object:
    """A mesh object with per-vertex colour, rest position and per-corner pattern coordinates."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], faces.tolist())
    mesh.polygons.foreach_set("use_smooth", np.full(len(faces), smooth))
    attr = mesh.attributes.new("tint", "FLOAT_VECTOR", "POINT")
    attr.data.foreach_set("vector", np.broadcast_to(color, vertices.shape).astype(np.float32).ravel())
    attr = mesh.attributes.new("rest", "FLOAT_VECTOR", "POINT")
    attr.data.foreach_set("vector", (vertices if rest is None else rest).astype(np.float32).ravel())
    if st is not None:
        attr = mesh.attributes.new("pattern", "FLOAT_VECTOR", "CORNER")
        flat = st.reshape(-1, 2)
        attr.data.foreach_set("vector", np.c_[flat, np.zeros(len(flat))].astype(np.float32).ravel())
    mesh.materials.append(material(mat))
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def area_light(name: str, place: tuple, aim: tuple, size: tuple[float, float], power: float, color: tuple) -> None:
    """A rectangular light."""
    from mathutils import Vector

    data = bpy.data.lights.new(name, "AREA")
    data.shape, data.size, data.size_y, data.energy, data.color = "RECTANGLE", *size, power, color
    obj = bpy.data.objects.new(name, data)
    obj.location = place
    obj.rotation_euler = (Vector(aim) - Vector(place)).to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(obj)


def setup(samples: int) -> None:
    """Engine, colour management, camera and lights."""
    from mathutils import Matrix

    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cy = scene.cycles
    cy.device, cy.samples, cy.use_denoising, cy.seed = "CPU", samples, True, SEED
    cy.max_bounces, cy.diffuse_bounces, cy.glossy_bounces = 6, 4, 2
    cy.sample_clamp_indirect = 4.0
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    scene.render.use_persistent_data = True
    scene.render.resolution_x, scene.render.resolution_y = COLOR_SIZE
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.view_settings.view_transform = "AgX"
    scene.view_settings.look = "AgX - Medium High Contrast"
    scene.view_settings.exposure = 0.1
    cam = bpy.data.cameras.new("colour")
    cam.sensor_fit, cam.sensor_width = "HORIZONTAL", 36.0
    cam.lens = COLOR_F * cam.sensor_width / COLOR_SIZE[0]
    cam.clip_start = 0.05
    # The principal point (479.5, 269.5) with pixel centres at integers is the middle of the image: no shift.
    obj = bpy.data.objects.new("colour", cam)
    pose = color_to_world() @ np.diag([1.0, -1.0, -1.0, 1.0])
    obj.matrix_world = Matrix(pose.tolist())
    scene.collection.objects.link(obj)
    scene.camera = obj
    world = bpy.data.worlds.new("world")
    scene.world = world
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (0.5, 0.55, 0.6, 1)
    world.node_tree.nodes["Background"].inputs[1].default_value = 0.3
    area_light("ceiling", (-0.25, 2.1, 2.5), (-0.25, 2.1, 0.0), (1.3, 1.3), 62.0, (1.0, 0.93, 0.84))
    area_light("window", (0.17, 4.68, 1.6), (0.0, 2.0, 0.7), (0.85, 1.0), 26.0, (0.82, 0.91, 1.0))
    area_light("behind", (-1.7, -0.6, 2.0), (0.0, 3.0, 1.0), (1.2, 1.2), 58.0, (0.95, 0.96, 1.0))


def main() -> None:
    """Build the scene, then move the people and the drawer for each frame."""
    work, out, samples = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    frames = [int(a) for a in sys.argv[4:]]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    setup(samples)
    data = np.load(work / "scene.npz", allow_pickle=False)
    names = [str(n) for n in data["names"]]
    objects = {}
    for i, name in enumerate(names):
        rest = data.get(f"rest{i}", None)
        st = data.get(f"st{i}", None)
        person = int(data["owner"][i]) >= 0
        objects[i] = add_mesh(
            name, data[f"v{i}"][0], data[f"f{i}"], str(data["materials"][i]), data[f"c{i}"], rest, st, person
        )
    for frame in frames:
        for i, obj in objects.items():
            v = data[f"v{i}"]
            if len(v) > 1:
                obj.data.vertices.foreach_set("co", v[frame].astype(np.float32).ravel())
                obj.data.update()
        bpy.context.scene.render.filepath = str(out / f"{frame:06d}.png")
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
