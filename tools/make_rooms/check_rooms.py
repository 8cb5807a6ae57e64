"""Checks the recordings with numbers and draws truth and detections over colour and depth.

usage: check_rooms.py [--dir DIR] [--sensors ...] [--pictures 0 5 9] [--sheet]
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path

import common
import cv2
import numpy as np
from common import Array
from layout import JOINTS

BONES = ((1, 2), (2, 3), (3, 4), (1, 5), (5, 6), (6, 7), (8, 9), (9, 10), (11, 12), (12, 13), (8, 11), (1, 8), (1, 11))
BONES += ((0, 1), (0, 14), (14, 16), (0, 15), (15, 17))


def project(points: Array, k: Array) -> Array:
    """Pixels of camera-frame points."""
    uvw = points @ k.T
    return uvw[:, :2] / np.where(np.abs(uvw[:, 2:]) < 1e-6, 1e-6, uvw[:, 2:])


def draw(image: Array, uv: Array, hidden: Array, there: Array, scale: float) -> None:
    """A skeleton: the person's right side red, left side green; hidden joints hollow."""

    def at(j: int) -> tuple[int, int]:
        return tuple(round(float((x + 0.5) * scale - 0.5)) for x in np.clip(uv[j], -5000, 5000))

    for a, b in BONES:
        if there[a] and there[b]:
            right = JOINTS[b].startswith("R")
            cv2.line(image, at(a), at(b), (60, 60, 255) if right else (60, 220, 60), 1, cv2.LINE_AA)
    for j in range(18):
        if there[j]:
            cv2.circle(image, at(j), 3, (0, 255, 255), 1 if hidden[j] else -1, cv2.LINE_AA)


def main() -> None:
    """Print the checks, write the pictures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--dir", type=Path, default=common.OUT)
    parser.add_argument("--sensors", nargs="*", default=["kinect2", "azure", "realsense"])
    parser.add_argument("--pictures", type=int, nargs="*", default=[])
    parser.add_argument("--sheet", action="store_true", help="four frames a picture, small")
    args = parser.parse_args()
    look = args.dir / "look"
    look.mkdir(parents=True, exist_ok=True)
    for name in args.sensors:
        folder = args.dir / name
        head = json.loads((folder / "recording.json").read_text())
        truth = json.loads((folder / "truth.json").read_text())["frames"]
        path = folder / "keypoints2d.json"
        found = {f["index"]: f["people"] for f in json.loads(path.read_text())["frames"]} if path.exists() else {}
        kc, kd = np.array(head["color"]["K"]), np.array(head["depth"]["K"])
        to_depth = np.linalg.inv(np.array(head["T_color_depth"]))
        gaps: list[list[float]] = [[] for _ in range(18)]
        blind = 0
        fine: list[bool] = []
        distance, shown, hidden, matched, errors, wrong = [], [], [], 0, [], []
        people, faces_away, sheet, valid = 0, 0, [], []
        for frame in truth:
            i = frame["index"]
            raw = cv2.imread(str(folder / "depth" / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED)
            z = raw * head["depth"]["unit_m"]
            valid.append((raw > 0).mean())
            picture = i in args.pictures
            color = cv2.imread(str(folder / "color" / f"{i:06d}.jpg"))
            tint = cv2.applyColorMap(np.clip((z - 0.8) / 5 * 255, 0, 255).astype(np.uint8), cv2.COLORMAP_TURBO)
            tint[raw == 0] = 0
            dets = color.copy() if color is not None else None
            for p in frame["people"]:
                people += 1
                xyz = np.array(p["keypoints"])
                occ, view = np.array(p["occluded"]), np.array(p["in_view"])
                d = xyz @ to_depth[:3, :3].T + to_depth[:3, 3]
                uc, ud = project(xyz, kc), project(d, kd)
                distance.append(float(np.linalg.norm(xyz[[8, 11]].mean(0))))
                shown.append(int(view.sum()))
                hidden += list(occ[view])
                faces_away += int(xyz[2, 0] > xyz[5, 0])
                if picture:
                    draw(color, uc, occ, np.ones(18, bool), 1)
                    draw(tint, ud, occ, np.ones(18, bool), 1)
                for j in np.flatnonzero(view & ~occ):
                    x, y = np.round(ud[j]).astype(int)
                    if not (2 <= x < z.shape[1] - 2 and 2 <= y < z.shape[0] - 2):
                        continue
                    box = z[y - 2 : y + 3, x - 2 : x + 3]
                    if not (box > 0).any():
                        blind += 1
                        continue
                    gap = float(d[j, 2] - np.median(box[box > 0]))
                    gaps[j].append(gap)
                    noise = 2 * 0.08 * d[j, 2] ** 2 / (kd[0, 0] * 0.05) if name == "realsense" else 0.0
                    fine.append(-0.05 - noise < gap < 0.25 + noise)
                    if not fine[-1]:
                        wrong.append((i, p["id"], JOINTS[j], round(gap, 2)))
                best = None
                for q in found.get(i, []):
                    rows = np.array(q["keypoints"])
                    on = (rows[:, 2] > 0) & view & ~occ
                    if on.sum() >= 2:
                        e = np.linalg.norm(rows[on, :2] - uc[on], axis=1)
                        torso = kc[0, 0] * np.linalg.norm(xyz[1] - xyz[[8, 11]].mean(0)) / xyz[1, 2]
                        if best is None or np.median(e / torso) < np.median(best):
                            best = e / torso
                if best is not None and np.median(best) < 0.3:
                    matched += 1
                    errors += list(best)
            if picture:
                for q in found.get(i, []):
                    rows = np.array(q["keypoints"])
                    draw(dets, rows[:, :2], rows[:, 2] < 0.5, rows[:, 2] > 0, 1)
                h = 420
                row = [cv2.resize(m, (round(m.shape[1] * h / m.shape[0]), h)) for m in (color, tint)]
                if not args.sheet:
                    row.append(cv2.resize(dets, (round(dets.shape[1] * h / dets.shape[0]), h)))
                sheet.append(np.concatenate(row, 1))
                cv2.putText(sheet[-1], f"{name} {i}", (8, 20), 0, 0.6, (255, 255, 255), 2)
                if not args.sheet:
                    cv2.imwrite(str(look / f"{name}{i:02d}.png"), sheet[-1])
        for k in range(0, len(sheet) if args.sheet else 0, 4):
            four = sheet[k : k + 4]
            four += [np.zeros_like(four[0])] * (4 - len(four))
            page = np.concatenate([np.concatenate(four[:2], 1), np.concatenate(four[2:], 1)], 0)
            cv2.imwrite(str(look / f"sheet_{name}_{k // 4:02d}.png"), page)
        flat = np.concatenate([np.array(g) for g in gaps])
        tally = Counter(len(f["people"]) for f in truth)
        print(f"== {name}: {len(truth)} frames, people {people} per frame {dict(tally)}, backs {faces_away}")
        print(f"   joints in view {np.mean(shown):.1f}/18, occluded share {np.mean(hidden):.3f}")
        print(f"   distance {np.min(distance):.2f} to {np.max(distance):.2f}, median {np.median(distance):.2f}")
        print(f"   valid depth {np.mean(valid):.3f}")
        good = f"{np.mean(fine):.4f} (realsense: with 2 sigma more)"
        print(f"   visible joints {len(flat)}, no depth {blind}, -0.05 to 0.25 m behind the surface {good}")
        print("   median gap cm", {JOINTS[j]: round(100 * float(np.median(g)), 1) for j, g in enumerate(gaps) if g})
        print("   wrong", Counter(w[2] for w in wrong).most_common(8), wrong[:14])
        if found:
            n = sum(len(v) for v in found.values())
            e = np.array(errors)
            q = np.quantile(e, [0.5, 0.9, 0.99]).round(3)
            print(f"   detections {n}, matched {matched}; seen joints' error in torsos, median, 90 %, 99 %: {q}")


if __name__ == "__main__":
    main()
