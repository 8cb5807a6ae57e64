"""Distance by apparent size: right for a usual body, in proportion, patient with foreshortened limbs."""

import numpy as np
import pytest

from understudy.apparent_size import distance_of_size
from understudy.skeleton import JOINT, JOINTS, N_JOINTS

BODY = {
    "nose": (0.0, -0.62), "neck": (0.0, -0.42), "eye": (0.032, -0.65), "ear": (0.068, -0.62), "shoulder": (0.15, -0.42),
    "elbow": (0.2, -0.15), "wrist": (0.22, 0.1), "hip": (0.105, 0.0), "knee": (0.11, 0.39), "ankle": (0.11, 0.79),
}  # fmt: skip
"""Right of the middle, down (metres)"""


def body(distance: float, aside: float = 0.0) -> np.ndarray:
    """Rays to somebody who faces the camera, `aside` radians from its axis."""
    x, y = np.array([BODY[n.split("_")[-1]] for n in JOINTS]).T
    points = np.column_stack([np.where([n.startswith("right") for n in JOINTS], -x, x), y, np.full(N_JOINTS, distance)])
    c, s = np.cos(aside), np.sin(aside)
    turned = points @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
    return turned[:, :2] / turned[:, 2:]


def only(ray: np.ndarray, *names: str) -> np.ndarray:
    keep = np.isin(np.arange(N_JOINTS), [JOINT[n] for n in names])
    return np.where(keep[:, None], ray, np.nan)


@pytest.mark.parametrize("aside", [0.0, 0.7])
@pytest.mark.parametrize("distance", [1.2, 2.0, 4.0, 6.0])
def test_a_usual_body_is_where_it_is(distance: float, aside: float):
    found, sigma = distance_of_size(body(distance, aside))
    assert abs(np.log(found / distance)) < 0.12
    assert 0.05 < sigma < 0.2


def test_half_the_size_is_twice_as_far():
    near, far = (distance_of_size(body(d))[0] for d in (2.0, 4.0))
    assert far / near == pytest.approx(2.0, rel=0.05)


def test_short_limbs_say_less_than_long_ones():
    """Arms that point at the camera do not move the person away as much as stretched ones bring it near."""
    ray = body(3.0)
    arms = [JOINT[f"{side}_{j}"] for side in ("right", "left") for j in ("elbow", "wrist")]
    shoulders = np.repeat(ray[[JOINT["right_shoulder"], JOINT["left_shoulder"]]], 2, axis=0)
    short, long = ray.copy(), ray.copy()
    short[arms] = shoulders + (ray[arms] - shoulders) * 0.5
    long[arms] = shoulders + (ray[arms] - shoulders) * 2.0
    known, away, near = (distance_of_size(r)[0] for r in (ray, short, long))
    assert 1.0 < away / known < 1.1 < known / near


def test_fewer_bones_say_it_with_less_certainty():
    everything = distance_of_size(body(3.0))
    arm = distance_of_size(only(body(3.0), "right_shoulder", "right_elbow"))
    assert arm is not None and arm[1] > 1.5 * everything[1]
    assert abs(np.log(arm[0] / 3.0)) < 1.5 * arm[1]


def test_nothing_to_measure():
    assert distance_of_size(np.full((N_JOINTS, 2), np.nan)) is None
    assert distance_of_size(only(body(3.0), "left_wrist")) is None
    assert distance_of_size(np.zeros((N_JOINTS, 2))) is None
