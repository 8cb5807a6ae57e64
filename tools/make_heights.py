"""Writes src/understudy/heights.npz: how high the joints of simulated people are over the floor (see `standing`).

usage: make_heights.py [--people N] [--out FILE]
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

import numpy as np

from understudy.files import write_atomically
from understudy.synthetic.bodies import load_bank
from understudy.synthetic.draw import Draw
from understudy.synthetic.samples import Samples

BODIES, BODY_SEED, SEED = 640, 1, 77


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=256)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "src/understudy/heights.npz")
    chosen = parser.parse_args()
    samples = Samples(load_bank("anny", BODIES, BODY_SEED))
    people = samples.people(Draw(SEED, samples.device), chosen.people)
    file = io.BytesIO()
    np.savez_compressed(file, heights=people.joints[..., 2].numpy().astype(np.float16))
    write_atomically(chosen.out, file.getvalue())
    print(f"wrote {chosen.out}: joints of {chosen.people} people")


if __name__ == "__main__":
    main()
