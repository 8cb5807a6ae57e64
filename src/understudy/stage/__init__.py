"""The stage: furniture that opens, a person who opens it, and recordings of that with exact truth, made with MuJoCo.

Needs the extra `stage` (mujoco).
"""

import os
import sys

if sys.platform == "linux":  # pictures off screen, also without a display; MuJoCo reads this when it is imported
    os.environ.setdefault("MUJOCO_GL", "egl")
