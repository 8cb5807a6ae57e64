"""Markers: time and error per frame, against OpenCV's solvePnP alone. Articulations: time of a fit.

    python benchmarks/objects.py [--frames N]

Rendered tags of 10 cm at several distances and tilts, exactly known; the alternative in the same run is
detectMarkers with its sub-pixel corners and solvePnP (IPPE square, the better of two).
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from common import report

from understudy.objects.articulation import REVOLUTE
from understudy.objects.fit import fit_articulation
from understudy.objects.marker_pose import model_corners
from understudy.objects.markers import DICTIONARIES, MarkerTracker

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import test_articulation as tracks
import test_markers as tags


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10, metavar="N", help="per distance and tilt")
    frames = parser.parse_args().frames
    rows, ours, theirs = [], [], []
    for distance in (0.7, 1.4, 2.1, 2.8, 3.5):
        for tilt in (0, 30, 60):
            row, seconds = compare(distance, tilt, frames)
            rows.append(row)
            ours.append(seconds[0])
            theirs.append(seconds[2])
    heads = [
        "m",
        "tilt",
        "edge px",
        "found",
        "depth: mm, deg",
        "colour: mm, deg",
        "solvePnP: mm, deg",
        "depth: NEES / 6",
    ]
    ms, alone = 1000 * np.median(ours), 1000 * np.median(theirs)
    truth = tracks.random_articulation(REVOLUTE, np.random.default_rng(0))
    T = tracks.noisy(truth.pose(tracks.opening(300, 1.2)), np.random.default_rng(1))
    start = time.process_time()
    for _ in range(3):
        fit_articulation(T)
    fitting = (time.process_time() - start) / 3
    notes = (
        f"Medians and 90th percentiles over {frames} frames each. A frame (1280 x 720, one tag): {ms:.1f} ms of "
        f"processor time, {ms / alone:.2f} x detectMarkers + solvePnP. Fit of an articulation, 300 poses, all kinds: "
        f"{1000 * fitting:.0f} ms."
    )
    report("objects", heads, rows, notes)


def compare(distance: float, tilt: float, frames: int) -> tuple[list[str], np.ndarray]:
    """A row of the table; median seconds of our poses with depth, of ours without, and of solvePnP's."""
    errors: list[list[np.ndarray]] = [[], [], []]
    seconds: list[list[float]] = [[], [], []]
    nees = []
    for seed in range(frames):
        T = tags.pose(distance, tilt, seed)
        frame = tags.rendered({7: T}, seed)
        for k, depth in enumerate((True, False)):
            tracker = MarkerTracker({7: tags.SIZE_M}, depth=depth)
            start = time.process_time()
            found = tracker.detect(frame).get(7)
            seconds[k].append(time.process_time() - start)
            if found is not None:
                e = tags.error(T, found.T_cam_marker)
                errors[k].append(e)
                if depth:
                    nees.append(e @ np.linalg.solve(found.covariance, e) / 6)
        start = time.process_time()
        other = solve_pnp(frame.color)
        seconds[2].append(time.process_time() - start)
        if other is not None:
            errors[2].append(tags.error(T, other))
    pixels = tags.CAMERA.fx * tags.SIZE_M / distance
    cells = [words(e) for e in errors]
    row = [f"{distance:.1f}", f"{tilt:.0f}", f"{pixels:.0f}", f"{len(errors[0])}/{frames}", *cells]
    return [*row, f"{np.mean(nees):.1f}" if nees else "-"], np.median(seconds, axis=1)


def words(errors: list[np.ndarray]) -> str:
    if not errors:
        return "-"
    e = np.array(errors)
    mm, deg = 1000 * np.linalg.norm(e[:, :3], axis=1), np.degrees(np.linalg.norm(e[:, 3:], axis=1))
    return ", ".join(f"{np.median(x):.1f} / {np.percentile(x, 90):.1f}" for x in (mm, deg))


def solve_pnp(color: np.ndarray) -> np.ndarray | None:
    """What most programs do."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    family = cv2.aruco.getPredefinedDictionary(DICTIONARIES["apriltag_36h11"])
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    corners, ids, _ = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(gray)
    if ids is None:
        return None
    model = model_corners(tags.SIZE_M)
    _, r, t = cv2.solvePnP(model, corners[0].reshape(4, 1, 2), tags.CAMERA.K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(r)[0], t.ravel()
    return T


if __name__ == "__main__":
    main()
