"""Blender colour for some frames of a recording, as a recording of its own with the same truth, without detections.

usage: render_rooms.py [--sensor kinect2] [--count 16] [--samples 6] [--limit-s 1500] [--dir DIR]
"""

from __future__ import annotations

import argparse
import json
import pickle
import resource
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import common
import cv2
import numpy as np
from common import SEED


def prepare(sensor_name: str, index: int, source: Path, work: Path) -> None:
    """Compose a frame again and store its meshes."""
    from sensors import SENSORS
    from stage import cast_people, compose, meshes

    sensor = SENSORS[sensor_name]
    attempt = json.loads((source / "parts" / f"{index:06d}.json").read_text())["attempt"]
    frame = compose(sensor, index, attempt, cast_people(sensor, index))
    assert frame is not None
    k = sensor.color_k
    camera = {"size": sensor.color_size, "f": float(k[0, 0]), "c": (float(k[0, 2]), float(k[1, 2])), "pose": frame.pose}
    (work / f"{index:06d}.pickle").write_bytes(pickle.dumps({"parts": meshes(frame).parts, "camera": camera}))


def _setup(camera: dict[str, Any], samples: int, room: np.ndarray, seed: int) -> None:
    """Engine, camera and lights for a room given by two corners."""
    import bpy
    from mathutils import Matrix
    from render import area_light

    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cy = scene.cycles
    cy.device, cy.samples, cy.use_denoising, cy.seed = "CPU", samples, True, SEED
    cy.max_bounces, cy.diffuse_bounces, cy.glossy_bounces, cy.sample_clamp_indirect = 4, 3, 1, 4.0
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    width, height = camera["size"]
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.render.image_settings.file_format = "PNG"
    scene.view_settings.view_transform = "AgX"
    scene.view_settings.look = "AgX - Medium High Contrast"
    scene.view_settings.exposure = 0.15
    cam = bpy.data.cameras.new("colour")
    cam.sensor_fit, cam.sensor_width, cam.clip_start = "HORIZONTAL", 36.0, 0.05
    cam.lens = camera["f"] * 36.0 / width
    cam.shift_x = -(camera["c"][0] - 0.5 * (width - 1)) / width
    cam.shift_y = (camera["c"][1] - 0.5 * (height - 1)) / width
    obj = bpy.data.objects.new("colour", cam)
    obj.matrix_world = Matrix((camera["pose"] @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist())
    scene.collection.objects.link(obj)
    scene.camera = obj
    world = bpy.data.worlds.new("world")
    scene.world = world
    world.use_nodes = True
    rng = np.random.default_rng([SEED, seed, 9])
    world.node_tree.nodes["Background"].inputs[1].default_value = 0.3
    low, high = room
    power = 3.0 * float(np.prod((high - low)[:2])) * rng.uniform(0.8, 1.2)
    mid = 0.5 * (low + high)
    top, warm = high[2] - 0.15, (1.0, 0.93, 0.84)
    for k, y in enumerate((mid[1] - 0.22 * (high - low)[1], mid[1] + 0.22 * (high - low)[1])):
        area_light(f"ceiling{k}", (mid[0], y, top), (mid[0], y, 0.0), (1.0, 1.0), 0.55 * power, warm)
    behind = (rng.uniform(-0.6, 0.6), max(low[1] + 0.1, -0.35), min(2.3, top))
    area_light("behind", behind, (0.0, 3.0, 1.0), (0.8, 0.8), 0.45 * power, (0.95, 0.96, 1.0))


def worker(work: Path, samples: int, limit: float, frames: list[int]) -> None:
    """Render until all is done or the CPU time is used up (in its own process)."""
    import bpy
    from render import add_mesh

    for index in frames:
        used = resource.getrusage(resource.RUSAGE_SELF)
        if used.ru_utime + used.ru_stime > limit:
            return
        data = pickle.loads((work / f"{index:06d}.pickle").read_bytes())
        bpy.ops.wm.read_factory_settings(use_empty=True)
        floor = next(v for name, _, v, *_ in data["parts"] if name == "floor")
        roof = next(v for name, _, v, *_ in data["parts"] if name == "ceiling")
        room = np.array([[*floor.min(0)[:2], 0.0], [*floor.max(0)[:2], roof[:, 2].min()]])
        _setup(data["camera"], samples, room, index)
        for name, material, v, f, tint, rest, st, soft in data["parts"]:
            add_mesh(name, v, f, material, tint, rest, st, soft)
        bpy.context.scene.render.filepath = str(work / f"{index:06d}.png")
        bpy.ops.render.render(write_still=True)
        used = resource.getrusage(resource.RUSAGE_SELF)
        print(f"frame {index}, CPU so far {used.ru_utime + used.ru_stime:.0f} s", file=sys.stderr, flush=True)


def main() -> None:
    """Prepare, render and write the recording of the frames that were rendered."""
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    parser = argparse.ArgumentParser()
    parser.add_argument("--sensor", default="kinect2")
    parser.add_argument("--count", type=int, default=16)
    parser.add_argument("--samples", type=int, default=6)
    parser.add_argument("--limit-s", type=float, default=1500.0)
    parser.add_argument("--dir", type=Path, default=common.OUT)
    parser.add_argument("--worker", type=int, nargs="*", help="used by the program itself")
    args = parser.parse_args()
    work = args.dir / "blender"
    if args.worker is not None:
        worker(work, args.samples, args.limit_s, args.worker)
        return
    work.mkdir(parents=True, exist_ok=True)
    source, out = args.dir / args.sensor, args.dir / f"{args.sensor}_color"
    truth = json.loads((source / "truth.json").read_text())
    total = len(truth["frames"])
    wanted = sorted({round(k * (total - 1) / max(args.count - 1, 1)) for k in range(args.count)})
    missing = [i for i in wanted if not (work / f"{i:06d}.png").exists()]
    for index in missing:
        if not (work / f"{index:06d}.pickle").exists():
            prepare(args.sensor, index, source, work)
    command = [sys.executable, __file__, "--dir", str(args.dir), "--samples", str(args.samples)]
    command += ["--limit-s", str(args.limit_s), "--worker", *map(str, missing)]
    if missing:
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    done = [i for i in wanted if (work / f"{i:06d}.png").exists()]
    for folder in ("color", "depth"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    frames, sources = [], []
    for new, index in enumerate(done):
        image = cv2.imread(str(work / f"{index:06d}.png"), cv2.IMREAD_COLOR).astype(float)
        image += np.random.default_rng([SEED, 77, index]).normal(size=image.shape) * 1.5
        path = out / "color" / f"{new:06d}.jpg"
        cv2.imwrite(str(path), np.clip(np.round(image), 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90])
        shutil.copy(source / "depth" / f"{index:06d}.png", out / "depth" / f"{new:06d}.png")
        frame = next(f for f in truth["frames"] if f["index"] == index)
        frames.append({"index": new, "people": frame["people"]})
        sources.append(index)
    (out / "truth.json").write_text(json.dumps({"frames": frames, "joints_note": truth["joints_note"]}) + "\n")
    (out / "source_frames.json").write_text(json.dumps({"recording": args.sensor, "indices": sources}) + "\n")
    shutil.copy(source / "recording.json", out / "recording.json")


if __name__ == "__main__":
    main()
