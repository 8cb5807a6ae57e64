"""Rotations over time: no lag, no bias at the ends, outliers and gaps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from understudy.errors import UnderstudyError
from understudy.hands.smoothing import smooth_rotations


def _turning(n: int = 60, rate: float = 1.5, dt: float = 1 / 30) -> tuple[np.ndarray, Rotation]:
    times = np.arange(n) * dt
    start = Rotation.from_rotvec([0.3, -0.8, 0.2])
    return times, start * Rotation.from_rotvec(np.outer(times, rate * np.array([0.6, 0.64, 0.48])))


def _apart(R: np.ndarray, truth: Rotation) -> np.ndarray:
    return (Rotation.from_matrix(R).inv() * truth).magnitude()


def test_a_steady_turn_is_left_as_it_is() -> None:
    times, truth = _turning()
    result = smooth_rotations(times, truth.as_matrix())
    assert _apart(result.R, truth).max() < 0.003  # also at the ends
    assert result.spread.max() < 0.003


def test_noise_shrinks_and_nothing_lags() -> None:
    times, truth = _turning(400)
    rng = np.random.default_rng(0)
    noisy = truth * Rotation.from_rotvec(rng.normal(0, 0.15, (len(times), 3)))
    result = smooth_rotations(times, noisy.as_matrix())
    assert np.mean(_apart(result.R, truth)) < 0.4 * np.mean((noisy.inv() * truth).magnitude())
    shifts = np.arange(-4, 5)
    inner = slice(20, -20)
    errors = [_apart(np.roll(result.R, -s, axis=0)[inner], truth[inner]).mean() for s in shifts]
    assert shifts[int(np.argmin(errors))] == 0


def test_palms_that_are_taken_for_backs_are_overruled() -> None:
    times, truth = _turning(90)
    R = truth.as_matrix()
    rng = np.random.default_rng(1)
    flipped = rng.choice(90, 14, replace=False)
    R[flipped] = (truth[flipped] * Rotation.from_rotvec([np.pi, 0, 0])).as_matrix()
    result = smooth_rotations(times, R)
    assert np.degrees(_apart(result.R, truth)).max() < 8


def test_doubtful_measurements_count_less() -> None:
    times, truth = _turning(30, rate=0.0)
    R = truth.as_matrix()
    R[::2] = (truth[::2] * Rotation.from_rotvec([0, 0.3, 0])).as_matrix()
    confidence = np.ones(30)
    even = smooth_rotations(times, R, confidence).R
    confidence[::2] = 0.05
    assert _apart(smooth_rotations(times, R, confidence).R, truth).mean() < 0.5 * _apart(even, truth).mean()


def test_gaps_are_bridged_when_short_and_left_open_when_long() -> None:
    times, truth = _turning(120)
    R = truth.as_matrix()
    R[20:23] = np.nan
    R[60:110] = np.nan
    result = smooth_rotations(times, R)
    assert _apart(result.R[20:23], truth[20:23]).max() < 0.01
    assert np.isnan(result.R[75:95]).all() and np.isnan(result.spread[75:95]).all()
    assert (result.support[75:95] < 0.3).all()


def test_one_long_recording_is_the_same_as_its_parts() -> None:
    times, truth = _turning(700)
    rng = np.random.default_rng(2)
    R = (truth * Rotation.from_rotvec(rng.normal(0, 0.1, (700, 3)))).as_matrix()
    whole = smooth_rotations(times, R).R
    part = smooth_rotations(times[200:330], R[200:330]).R
    np.testing.assert_allclose(whole[220:310], part[20:110], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"times_s": np.zeros(5)}, "increase"),
        ({"sigma_s": 0.0}, "positive"),
        ({"R": np.zeros((4, 3, 3))}, "shape"),
        ({"confidence": np.full(5, 1.5)}, "confidence"),
    ],
)
def test_bad_input_is_named(change: dict[str, object], message: str) -> None:
    good = {"times_s": np.arange(5.0), "R": np.tile(np.eye(3), (5, 1, 1)), "confidence": np.ones(5), "sigma_s": 0.1}
    with pytest.raises(UnderstudyError, match=message):
        smooth_rotations(**{**good, **change})  # type: ignore[arg-type]
