"""Makes the bundled demonstration (src/understudy/samples/drawer) from a recording of the stage.

    understudy stage record --task drawer --demos 1 --seed 11 --fps 5 --out rec
    python tools/make_drawer_sample.py rec/drawer_00 src/understudy/samples/drawer

JPEG quality 85 and depth in steps of 2 mm: 8 instead of 11 MB. The steps are as large as the camera's noise at 1.5 m;
the demonstration that is estimated stays as near to the truth (docs/teaching.md).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2

from understudy import recordings
from understudy.files import write_atomically
from understudy.recordings.writer import write_recording
from understudy.stage.truth import read_stage_truth, write_stage_truth

UNIT_M, JPEG_QUALITY = 0.002, 85


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    with recordings.open(args.recording) as recording:
        options = {"fps": recording.fps, "unit_m": UNIT_M, "jpeg_quality": JPEG_QUALITY, "overwrite": True}
        write_recording(args.out, recording, truth=recording.truth, **options)
    write_stage_truth(args.out, read_stage_truth(args.recording))
    for path in (args.out / "depth").glob("*.png"):
        pack(path)
    size = sum(p.stat().st_size for p in args.out.rglob("*") if p.is_file())
    print(f"{args.out}: {size / 1e6:.1f} MB")


def pack(path: Path) -> None:
    """The smallest of the PNG encodings of a depth image."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    best = path.read_bytes()
    for strategy in (cv2.IMWRITE_PNG_STRATEGY_DEFAULT, cv2.IMWRITE_PNG_STRATEGY_FILTERED):
        done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_STRATEGY, strategy])
        if done and len(data) < len(best):
            best = data.tobytes()
    write_atomically(path, best)


if __name__ == "__main__":
    main()
