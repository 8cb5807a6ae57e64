"""Checks the recording with numbers and draws pictures to look at (into /tmp/make_sample/look).

usage: check.py [RECORDING_DIR]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
from layout import JOINTS, OUT, WORK

BONES = [
    (1, 2),
    (2, 3),
    (3, 4),
    (1, 5),
    (5, 6),
    (6, 7),
    (8, 9),
    (9, 10),
    (11, 12),
    (12, 13),
    (8, 11),
    (1, 8),
    (1, 11),
    (0, 1),
    (0, 14),
    (14, 16),
    (0, 15),
    (15, 17),
]


def project(points: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Pixels of camera-frame points."""
    return np.stack(
        [k[0, 0] * points[:, 0] / points[:, 2] + k[0, 2], k[1, 1] * points[:, 1] / points[:, 2] + k[1, 2]], 1
    )


def draw(image: np.ndarray, uv: np.ndarray, hidden: np.ndarray, scale: int) -> None:
    """A skeleton: person's right side red, left side green; hidden joints hollow."""

    def at(j: int) -> tuple[int, int]:
        return tuple(round((x + 0.5) * scale - 0.5) for x in uv[j])

    for a, b in BONES:
        right = JOINTS[b].startswith("R")
        cv2.line(image, at(a), at(b), (60, 60, 255) if right else (60, 220, 60), 1, cv2.LINE_AA)
    for j in range(18):
        cv2.circle(image, at(j), 3, (0, 255, 255), 1 if hidden[j] else -1, cv2.LINE_AA)


def main() -> None:
    """Print the checks, write the pictures."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else OUT
    look = WORK / "look"
    look.mkdir(parents=True, exist_ok=True)
    head = json.loads((folder / "recording.json").read_text())
    truth = json.loads((folder / "truth.json").read_text())["frames"]
    kc, kd = np.array(head["color"]["K"]), np.array(head["depth"]["K"])
    to_depth = np.linalg.inv(np.array(head["T_color_depth"]))
    lengths: dict[tuple[int, int], list[list[float]]] = {}
    torso, hidden_count, noise = [], {}, []
    for frame in truth:
        k = frame["index"]
        raw = cv2.imread(str(folder / "depth" / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED)
        z = raw * head["depth"]["unit_m"]
        tint = cv2.applyColorMap(np.clip((z - 1.0) / 4.0 * 255, 0, 255).astype(np.uint8), cv2.COLORMAP_TURBO)
        tint[raw == 0] = 0
        cv2.imwrite(str(look / f"depth{k:02d}.png"), tint)
        tint = cv2.resize(tint, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
        color = cv2.imread(str(folder / "color" / f"{k:06d}.jpg"))
        exact = WORK / f"exact{k:02d}.npy"
        if exact.exists():
            e = np.load(exact)
            both = (e > 0) & (z > 0) & (np.abs(e - z) < 0.05)
            noise.append(float(np.std((e - z)[both])))
        for person in frame["people"]:
            p = np.array(person["keypoints"])
            occ = np.array(person["occluded"])
            d = p @ to_depth[:3, :3].T + to_depth[:3, 3]
            uc, ud = project(p, kc), project(d, kd)
            if color is not None:
                draw(color, uc, occ, 1)
                for side, wrist in (("right", 4), ("left", 7)):
                    n = np.array(person["hands"][side]["normal"])
                    tip = project((p[wrist] + 0.12 * n)[None], kc)[0]
                    cv2.arrowedLine(color, tuple(map(int, uc[wrist])), tuple(map(int, tip)), (255, 0, 255), 2)
            draw(tint, ud, occ, 2)
            for bone in BONES:
                lengths.setdefault((person["id"], *bone), []).append(float(np.linalg.norm(p[bone[0]] - p[bone[1]])))
            for j in (1, 2, 5, 8, 11):
                x, y = np.round(ud[j]).astype(int)
                box = z[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3]
                if not occ[j] and (box > 0).any():
                    torso.append(float(d[j, 2] - np.median(box[box > 0])))
            for j in np.flatnonzero(occ):
                key = f"{person['id']}.{JOINTS[j]}"
                hidden_count[key] = hidden_count.get(key, 0) + 1
            if k == 0:
                print(
                    f"person {person['id']} in view {sum(person['in_view'])}/18, distance",
                    np.linalg.norm(p[[8, 11]].mean(0)).round(2),
                    "u of RShoulder/LShoulder",
                    uc[2, 0].round(),
                    uc[5, 0].round(),
                    "max out-of-depth-image",
                    int(((ud < 0) | (ud > [511, 423])).any(1).sum()),
                )
            if k in (0, len(truth) - 1):
                print(
                    "  frame",
                    k,
                    "wrists",
                    p[4].round(2),
                    p[7].round(2),
                    "ankles",
                    p[10].round(2),
                    p[13].round(2),
                    "neck error",
                    np.abs(p[1] - 0.5 * (p[2] + p[5])).max(),
                )
        if color is not None:
            cv2.imwrite(str(look / f"color{k:02d}.png"), color)
        cv2.imwrite(str(look / f"raw{k:02d}.png"), tint)
    spread = {
        f"{a}:{JOINTS[b]}-{JOINTS[c]}": (round(np.mean(x), 3), round(np.ptp(x) * 1000, 2))
        for (a, b, c), x in lengths.items()
    }
    print("bone length m, spread mm:", spread)
    print(
        "visible torso joints: joint z minus surface z, min/mean/max",
        np.min(torso).round(3),
        np.mean(torso).round(3),
        np.max(torso).round(3),
        "n",
        len(torso),
    )
    print("occluded frames:", hidden_count)
    print("depth error std m (where < 5 cm):", np.round(noise, 4))
    size = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    print("bytes", size, {n: sum(f.stat().st_size for f in (folder / n).iterdir()) for n in ("color", "depth")})


if __name__ == "__main__":
    main()
