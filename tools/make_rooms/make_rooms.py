"""Makes the validation recordings. See README.md.

usage: make_rooms.py [--sensors kinect2 azure realsense] [--frames N] [--out DIR] [--again]
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from pathlib import Path
from typing import Any

import common
import cv2
import numpy as np
from common import SEED
from detections import detect_frame
from sensor import Scene
from sensors import SENSORS, Sensor, header, raw_depth, shaded_color
from stage import Frame, Meshes, cast_people, compose, meshes, truth_of

NOTE = (
    "Made, not measured: clothed bodies of anny 0.6.2, joints as in tools/make_sample (rotation centres of the "
    "skeleton; face from anny's key points; neck the midpoint of the shoulders). Occluded: the first surface on the "
    "colour camera's ray is another object or person, or the own body or clothes more than 0.12 m (face 0.06 m, hips "
    "0.15 to 0.22 m by build) before the joint."
)


def good_frame(sensor: Sensor, index: int) -> tuple[Frame, Meshes, Scene, list[dict[str, Any]], int]:
    """The first composition that fits and shows its people well enough: at most one in the dark, and seldom."""
    cast = cast_people(sensor, index)
    for attempt in range(60):
        frame = compose(sensor, index, attempt, cast)
        if frame is None:
            continue
        mesh = meshes(frame)
        scene = Scene(mesh.vertices, mesh.faces)
        people = truth_of(frame, scene, mesh, sensor)
        seen = [sum(v and not o for v, o in zip(p["in_view"], p["occluded"], strict=True)) for p in people]
        poor = sum(n < 4 for n in seen)
        few = attempt < 40 and (float(np.mean(seen)) < 7.5 or poor > int(frame.rng.random() < 0.25))
        if max(seen) >= 8 and not few:
            return frame, mesh, scene, people, attempt
    raise RuntimeError(f"{sensor.name} frame {index}: no composition fits")


def make_frame(sensor: Sensor, index: int, out: Path) -> None:
    """Write one frame's images and its part of the truth."""
    start = time.time()
    frame, mesh, scene, people, attempt = good_frame(sensor, index)
    rng = np.random.default_rng([SEED, len(sensor.name), index, 1000])
    raw = raw_depth(scene, frame.pose, sensor, mesh.dark, rng)
    rgb = shaded_color(scene, frame.pose, sensor, mesh.color, rng)
    found = detect_frame(people, sensor.color_k, sensor.color_size, rng)
    cv2.imwrite(str(out / "depth" / f"{index:06d}.png"), raw)
    cv2.imwrite(str(out / "color" / f"{index:06d}.jpg"), rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    part = {"people": people, "found": found, "attempt": attempt}
    (out / "parts" / f"{index:06d}.json").write_text(json.dumps(part))
    names = [p["posture"] for p in people]
    print(f"{sensor.name} {index}: {names} attempt {attempt}, {time.time() - start:.1f} s", flush=True)


def gather(sensor: Sensor, out: Path) -> None:
    """recording.json, truth.json and keypoints2d.json from the frames that are there."""
    truth, found, notes = [], [], []
    for path in sorted((out / "parts").glob("*.json")):
        part = json.loads(path.read_text())
        index = int(path.stem)
        notes.append({"index": index, "postures": [p.pop("posture") for p in part["people"]]})
        truth.append({"index": index, "people": part["people"]})
        found.append({"index": index, "people": part["found"]})
    (out / "recording.json").write_text(json.dumps(header(sensor), indent=1) + "\n")
    (out / "truth.json").write_text(json.dumps({"frames": truth, "joints_note": NOTE}) + "\n")
    (out / "keypoints2d.json").write_text(json.dumps({"frames": found}) + "\n")
    (out / "postures.json").write_text(json.dumps(notes) + "\n")


def main() -> None:
    """Make what is missing."""
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    parser = argparse.ArgumentParser()
    parser.add_argument("--sensors", nargs="*", default=list(SENSORS))
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--out", type=Path, default=common.OUT)
    parser.add_argument("--again", action="store_true", help="make frames anew that are there already")
    args = parser.parse_args()
    for name in args.sensors:
        out = args.out / name
        for folder in ("color", "depth", "parts"):
            (out / folder).mkdir(parents=True, exist_ok=True)
        for index in range(args.frames):
            if args.again or not (out / "parts" / f"{index:06d}.json").exists():
                make_frame(SENSORS[name], index, out)
        gather(SENSORS[name], out)


if __name__ == "__main__":
    main()
