import numpy as np

from understudy.tracking import MEMORY, IdentityTracker
from understudy.types import Keypoints2D, Person


def person(x: float, z: float = 3.0) -> Person:
    """Somebody at (x, 0, z) metres, seen by a camera with f = 500 px."""
    keypoints = np.tile((x, 0.0, z), (18, 1)) + np.random.default_rng(0).normal(0, 0.1, (18, 3))
    uv = 500 * keypoints[:, :2] / keypoints[:, 2:] + 500
    seen = Keypoints2D.where(uv, np.ones(18))
    return Person(seen, keypoints, np.ones(18), np.full(18, 0.02), ("observed",) * 18)


def failed(x: float) -> Person:
    return Person.failure(person(x).keypoints_2d, "no depth")


def ids(people):
    return [p.id for p in people]


def test_ids_stay_whatever_the_order():
    tracker = IdentityTracker()
    assert ids(tracker.update([person(-1), person(0), person(1)])) == [0, 1, 2]
    assert ids(tracker.update([person(1.05), person(-0.9), person(0.1)])) == [2, 0, 1]


def test_a_newcomer_and_one_who_comes_back():
    tracker = IdentityTracker()
    tracker.update([person(-1), person(1)])
    assert ids(tracker.update([person(1)])) == [1]
    assert ids(tracker.update([person(3), person(1), person(-1)])) == [2, 1, 0]
    for _ in range(MEMORY + 1):
        tracker.update([person(1)])
    assert ids(tracker.update([person(-1), person(1)])) == [3, 1]


def test_people_without_depth_keep_their_ids_too():
    tracker = IdentityTracker()
    tracker.update([person(-1), failed(1)])
    assert ids(tracker.update([failed(1.02), failed(-1.01)])) == [1, 0]
    assert ids(tracker.update([person(-1), person(1)])) == [0, 1]


def test_numbering_again_changes_nothing():
    """Stored results are numbered again when a recording is resumed: same ids, whatever ids they carry."""
    frames = [[person(-1), person(0.5)], [person(0.6), person(-1.1), person(2)], [], [person(2.1), person(-1.0)]]
    tracker = IdentityTracker()
    numbered = [tracker.update(f) for f in frames]
    again = IdentityTracker()
    assert [ids(again.update(f)) for f in numbered] == [ids(f) for f in numbered]
