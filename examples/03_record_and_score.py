"""Write a recording folder, estimate it with resuming and ids over time, and score it against the truth."""

import tempfile
from pathlib import Path

import understudy
from understudy.metrics import evaluate
from understudy.pipeline import estimate_recording

source = understudy.recordings.open("sample")
with tempfile.TemporaryDirectory() as folder:
    first_frames = [source[i] for i in range(2)]
    understudy.recordings.write_recording(Path(folder) / "short", first_frames, fps=source.fps)
    short = understudy.recordings.open(Path(folder) / "short")

    result = estimate_recording(short, Path(folder) / "result", overlays=False)
    print("ids per frame:", [[person.id for person in frame.people] for frame in result.frames])

    scores = evaluate(result.frames, source.truth)
    visible = scores.joints["visible"]
    print(f"visible joints: mean error {100 * visible.epe_m:.1f} cm (frames not estimated count as missed people)")
