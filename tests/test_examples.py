"""Every numbered example runs and says something sensible."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9]*.py"))


def test_there_are_examples():
    assert len(EXAMPLES) >= 3


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_example(path: Path, models: None):
    done = subprocess.run([sys.executable, str(path)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    expected = {
        "01_first_people": "person 1: neck at",
        "02_your_own_camera": "within 10 cm",
        "03_record_and_score": "mean error",
    }
    assert expected[path.stem] in done.stdout
