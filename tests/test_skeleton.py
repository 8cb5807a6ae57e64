import numpy as np
import pytest

from understudy.errors import UnderstudyError
from understudy.skeleton import BONES, FLIP, JOINT, JOINTS, LAYOUTS, N_JOINTS, to_coco18


def test_order_is_openpose_coco18():
    order = "nose neck RShoulder RElbow RWrist LShoulder LElbow LWrist RHip RKnee RAnkle LHip LKnee LAnkle"
    order += " REye LEye REar LEar"
    short = [name.replace("right_", "R").replace("left_", "L") for name in JOINTS]
    assert [s.lower() for s in short] == [s.lower() for s in order.split()]


def test_flip_exchanges_sides_and_is_its_own_inverse():
    assert (FLIP[FLIP] == np.arange(N_JOINTS)).all()
    assert JOINTS[FLIP[JOINT["left_wrist"]]] == "right_wrist"
    assert {tuple(sorted((FLIP[a], FLIP[b]))) for a, b in BONES} == {tuple(sorted(b)) for b in BONES}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_mirror(layout: str):
    """Exchanging left and right before the map and after it is the same: no layout mixes up the sides."""
    n, mapping = LAYOUTS[layout]
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.uniform(10, 500, (n, 2)), rng.uniform(0.5, 1, n)])
    mirrored = rows.copy()
    for joint, source in enumerate(mapping):
        if not isinstance(source, tuple):
            mirrored[source] = rows[mapping[FLIP[joint]]]
    np.testing.assert_allclose(to_coco18(mirrored, layout), to_coco18(rows, layout)[FLIP])


def test_neck_is_the_midpoint_and_needs_both_shoulders():
    rows = np.zeros((33, 3))
    rows[11], rows[12] = (100, 50, 0.9), (60, 54, 0.7)
    np.testing.assert_allclose(to_coco18(rows, "blazepose")[JOINT["neck"]], (80, 52, 0.7))
    rows[11, 2] = 0
    out = to_coco18(rows, "blazepose")
    np.testing.assert_array_equal(out[[JOINT["neck"], JOINT["left_shoulder"]]], 0)
    assert out[JOINT["right_shoulder"], 2] == 0.7


def test_wrong_layouts():
    with pytest.raises(UnderstudyError, match=r"'smpl': must be one of 'coco_18'"):
        to_coco18(np.zeros((24, 3)), "smpl")
    with pytest.raises(UnderstudyError, match="has 25 rows of 3"):
        to_coco18(np.zeros((24, 3)), "body_25")
