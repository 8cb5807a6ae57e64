"""The scores of demonstrations: zero for the truth itself, and exactly what was added to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demonstration_scenes import door_demonstration
from scipy.spatial.transform import Rotation

from understudy.benchmark.demonstrations import HEADS, TrueDemonstration, score, table
from understudy.demonstration.demonstration import Demonstration, Segments
from understudy.errors import UnderstudyError
from understudy.geometry import inverse, rigid
from understudy.trajectories import PlanarTrack, PoseTrack


def truth_of(demo: Demonstration) -> TrueDemonstration:
    T_cam_world = inverse(demo.T_world_cam)
    T_world_torso = np.tile(np.eye(4), (len(demo), 1, 1))
    T_world_torso[:, :3, :3] = Rotation.from_rotvec(demo.torso.xy_yaw[:, 2:] * [0, 0, 1]).as_matrix()
    T_world_torso[:, :2, 3] = demo.torso.xy_yaw[:, :2]
    return TrueDemonstration(
        demo.task,
        demo.times_s,
        demo.acting,
        T_cam_world @ demo.hand.T_world_x,
        np.ones(len(demo), bool),
        T_cam_world @ T_world_torso,
        T_cam_world @ demo.object.T_world_x,
        demo.articulation.moved(T_cam_world),
        demo.articulation.position(demo.object.T_world_x),
    )


@pytest.fixture
def demo() -> Demonstration:
    made = door_demonstration()
    begin, end = truth_of(made).boundaries_s
    grasp, release = np.searchsorted(made.times_s, [begin, end])
    return replace(made, segments=Segments(int(grasp), int(release)))


def test_the_truth_has_no_error_in_whatever_world_it_is_given(demo):
    truth = truth_of(demo)
    T_move = rigid(Rotation.from_euler("z", 70, degrees=True).as_matrix(), np.array([1.0, 2, 0]))
    for own in (demo, replace(door_demonstration(T_move=T_move), segments=demo.segments)):
        e = score(own, truth)
        for name in ("hand_m", "hand_turn_rad", "torso_m", "heading_rad", "object_m", "object_rad", "motion_m"):
            assert len(getattr(e, name)) == len(demo) and getattr(e, name).max() < 1e-6, name
        assert np.abs(e.boundaries_s).max() <= 0.1
        assert e.kind_right and e.acting_right and e.axis_rad < 1e-9 and e.radius_m < 1e-9 and e.range_share < 1e-3
        assert e.hand_given == 1


def test_errors_are_what_was_added(demo):
    truth = truth_of(demo)
    T = demo.hand.T_world_x.copy()
    T[:, :3, 3] += [0.03, 0, 0.04]
    turned = demo.torso.xy_yaw + [0.06, -0.08, np.radians(370)]
    moved = demo.object.T_world_x @ rigid(Rotation.from_euler("x", 3, degrees=True).as_matrix(), np.zeros(3))
    off = replace(
        demo,
        hand=PoseTrack(T, np.tile(np.eye(6) * 0.05**2 / 3, (len(demo), 1, 1)), demo.hand.observed, demo.hand.oriented),
        torso=PlanarTrack(turned, demo.torso.covariance, demo.torso.observed),
        object=PoseTrack(moved, demo.object.covariance, demo.object.observed, demo.object.oriented),
        segments=Segments(demo.segments.grasp + 4, demo.segments.release - 1),
        acting="left",
    )
    e = score(off, truth)
    np.testing.assert_allclose(e.hand_m, 0.05, atol=1e-9)
    assert e.nees == pytest.approx(3, rel=1e-6)
    np.testing.assert_allclose(e.torso_m, 0.1, atol=1e-9)
    np.testing.assert_allclose(np.degrees(e.heading_rad), 10, atol=1e-6)
    np.testing.assert_allclose(np.degrees(e.object_rad), 3, atol=1e-6)
    np.testing.assert_allclose(e.object_m, 0, atol=1e-9)
    assert e.boundaries_s[0] > 0.3 and not e.acting_right


def test_hands_that_are_hidden_or_not_given_do_not_count(demo):
    truth = truth_of(demo)
    visible = truth.hand_visible.copy()
    visible[:30] = False
    demo.hand.T_world_x[:30, :3, 3] += 1.0
    demo.hand.observed[30:40] = False
    e = score(demo, replace(truth, hand_visible=visible))
    assert e.hand_m.max() < 1e-9 and e.hand_given == pytest.approx(50 / 60)


def test_the_table_has_a_row_for_each_task_and_one_for_all(demo):
    errors = [score(demo, truth_of(demo)) for _ in range(2)]
    heads, rows = table([*errors, replace(errors[0], task="drawer")])
    assert heads == HEADS and [r[:2] for r in rows] == [["swivel_door", "2"], ["drawer", "1"], ["all", "3"]]
    assert all(len(r) == len(heads) for r in rows)
    assert rows[2][heads.index("kind right")] == "3/3"


def test_another_time_is_an_error(demo):
    with pytest.raises(UnderstudyError, match="overlap"):
        score(demo, replace(truth_of(demo), times_s=demo.times_s + 1000))
