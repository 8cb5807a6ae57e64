"""Makes the bundled sample recording. See README.md.

usage: make_sample.py [--frames 0 6 ...] [--samples N] [--no-color] [--out DIR]
"""

from __future__ import annotations

import argparse
import json
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bodies import Body, build_bodies
from clothes import dress
from hair import make_hair
from layout import (
    COLOR_K,
    COLOR_SIZE,
    DEPTH_K,
    DEPTH_SIZE,
    DEPTH_UNIT,
    FPS,
    FRAMES,
    OUT,
    PEOPLE,
    SEED,
    WORK,
    color_to_world,
    depth_to_color,
)
from meshes import Piece
from motion import drawer_pull, pose_a, pose_b, time_of
from rig import skin, solve
from room import build_room

NOTICE = """Sample recording 'room'

Made by the understudy project itself, by tools/make_sample (rendered with Blender; no real person is shown).
The bodies come from anny 0.6.2 (https://github.com/naver/anny, code Apache-2.0, Copyright NAVER Corp.),
whose body data are MakeHuman assets under CC0 1.0. Poses, clothes, hair, room and sensor simulation are the
project's own. The recording is distributed under the project's MIT licence.
"""


def bodies() -> list[Body]:
    """The two rest bodies, kept in the work folder between runs."""
    key = repr(PEOPLE).encode()
    cache = WORK / "bodies.pickle"
    if cache.exists():
        old, found = pickle.loads(cache.read_bytes())
        if old == key:
            return found
    made = build_bodies(PEOPLE)
    cache.write_bytes(pickle.dumps((key, made)))
    return made


def animate(people: list[Body]) -> tuple[dict[str, Any], list[list[tuple[np.ndarray, np.ndarray]]]]:
    """The scene file's arrays, and the posed skeletons per frame and person."""
    skeletons = []
    for k in range(FRAMES):
        t = time_of(k)
        skeletons.append([solve(people[0], pose_a(people[0], t)), solve(people[1], pose_b(people[1], t))])
    arrays: dict[str, Any] = {}
    names, owner, materials, dark = [], [], [], []
    for p, (body, person) in enumerate(zip(people, PEOPLE, strict=True)):
        pieces: list[Piece] = [
            *dress(body, person, SEED + 10 * p),
            make_hair(body, person, SEED + 10 * p + 5),
        ]
        for piece in pieces:
            i = len(names)
            names.append(f"{person.name}.{piece.name}")
            owner.append(p)
            materials.append(piece.material)
            dark.append({"hair": 0.62, "leather": 0.12 if p == 0 else 0.0}.get(piece.material, 0.0))
            frames = [skin(piece.vertices, piece.weights, body.heads, *skeletons[k][p]) for k in range(FRAMES)]
            arrays[f"v{i}"], arrays[f"f{i}"] = np.stack(frames), piece.faces
            arrays[f"c{i}"], arrays[f"rest{i}"] = piece.color, piece.vertices
            if piece.st is not None:
                arrays[f"st{i}"] = piece.st
    for thing in build_room():
        i = len(names)
        names.append(thing.name)
        owner.append(-1)
        materials.append(thing.material)
        dark.append(0.0)
        shift = [np.array([-drawer_pull(time_of(k)), 0.0, 0.0]) for k in range(FRAMES if thing.drawer else 1)]
        arrays[f"v{i}"] = np.stack([thing.vertices + (s if thing.drawer else 0.0) for s in shift])
        arrays[f"f{i}"], arrays[f"c{i}"], arrays[f"rest{i}"] = (
            thing.faces,
            np.array(thing.color),
            thing.vertices,
        )
    arrays.update(names=np.array(names), owner=np.array(owner), materials=np.array(materials), dark=np.array(dark))
    return arrays, skeletons


def merged(arrays: dict[str, Any], k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All triangles of a frame, and for every face the index of its mesh."""
    vertices, faces, source, n = [], [], [], 0
    for i in range(len(arrays["names"])):
        v = arrays[f"v{i}"]
        v = v[k] if len(v) > 1 else v[0]
        vertices.append(v)
        faces.append(arrays[f"f{i}"] + n)
        source.append(np.full(len(arrays[f"f{i}"]), i))
        n += len(v)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(source)


def write_depth_and_truth(arrays: dict[str, Any], skeletons: list, people: list[Body], out: Path) -> None:
    """Depth images, truth.json, and the exact depth for check.py."""
    from sensor import Scene, depth_image
    from truth import NOTE, person_truth

    (out / "depth").mkdir(parents=True, exist_ok=True)
    pose = color_to_world() @ depth_to_color()
    frames = []
    for k in range(FRAMES):
        vertices, faces, source = merged(arrays, k)
        scene = Scene(vertices, faces)
        raw, exact = depth_image(scene, pose, arrays["dark"][source], np.random.default_rng([SEED, k]))
        cv2.imwrite(str(out / "depth" / f"{k:06d}.png"), raw, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        np.save(WORK / f"exact{k:02d}.npy", exact)
        owner = arrays["owner"][source].astype(np.int32)
        frames.append(
            {
                "index": k,
                "people": [person_truth(scene, owner, p, people[p], *skeletons[k][p]) for p in range(len(people))],
            }
        )
    (out / "truth.json").write_text(json.dumps({"frames": frames, "joints_note": NOTE}) + "\n")


def write_color(out: Path, samples: int, frames: list[int]) -> None:
    """Render in a process of its own, then store JPEG files."""
    png = WORK / "color"
    png.mkdir(parents=True, exist_ok=True)
    (out / "color").mkdir(parents=True, exist_ok=True)
    here = Path(__file__).parent
    subprocess.run(
        [sys.executable, str(here / "render.py"), str(WORK), str(png), str(samples), *map(str, frames)],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    for k in frames:
        image = cv2.imread(str(png / f"{k:06d}.png"), cv2.IMREAD_COLOR).astype(float)
        image += np.random.default_rng([SEED, 77, k]).normal(size=image.shape) * 1.2  # a little sensor noise
        cv2.imwrite(
            str(out / "color" / f"{k:06d}.jpg"),
            np.clip(np.round(image), 0, 255).astype(np.uint8),
            [cv2.IMWRITE_JPEG_QUALITY, 88],
        )


def write_header(out: Path) -> None:
    """recording.json and NOTICE.txt."""

    def camera(size: tuple[int, int], k: np.ndarray) -> dict[str, Any]:
        return {
            "width": size[0],
            "height": size[1],
            "K": k.tolist(),
            "distortion_model": "none",
            "distortion": [],
        }

    header = {
        "format": "rgbd-recording/1",
        "fps": FPS,
        "timestamps_s": [round(k / FPS, 6) for k in range(FRAMES)],
        "color": camera(COLOR_SIZE, COLOR_K),
        "depth": {**camera(DEPTH_SIZE, DEPTH_K), "unit_m": DEPTH_UNIT, "registered": False},
        "T_color_depth": depth_to_color().round(9).tolist(),
    }
    (out / "recording.json").write_text(json.dumps(header, indent=1) + "\n")
    (out / "NOTICE.txt").write_text(NOTICE)


def main() -> None:
    """Make the recording."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, nargs="*", default=list(range(FRAMES)), help="colour frames to render")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--no-color", action="store_true")
    parser.add_argument("--out", type=Path, default=OUT)
    args = parser.parse_args()
    WORK.mkdir(parents=True, exist_ok=True)
    args.out.mkdir(parents=True, exist_ok=True)
    people = bodies()
    arrays, skeletons = animate(people)
    np.savez(WORK / "scene.npz", **arrays)
    write_depth_and_truth(arrays, skeletons, people, args.out)
    write_header(args.out)
    if not args.no_color:
        write_color(args.out, args.samples, args.frames)


if __name__ == "__main__":
    main()
