"""Random postures: valid rotations, human, what their names say, reproducible."""

from __future__ import annotations

import math
from functools import cache

import pytest

torch = pytest.importorskip("torch")

from understudy.errors import UnderstudyError  # noqa: E402
from understudy.synthetic import kinematics as kin  # noqa: E402
from understudy.synthetic.poses import (  # noqa: E402
    ACTIVITIES,
    NAMES,
    interpolate,
    sample_poses,
    sequence,
    within_limits,
)
from understudy.synthetic.segments import SEGMENT, SEGMENTS  # noqa: E402

FLIP = torch.tensor([-1.0, 1.0, 1.0])


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Small tensors: more threads only wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def generator(seed: int = 0):
    return torch.Generator().manual_seed(seed)


def segment(rotations, name):
    return rotations[:, SEGMENT[name]]


@cache
def only(activity: str, n: int = 150):
    batch = sample_poses(n, generator(3), mix={activity: 1.0})
    assert set(batch.names) == {activity}
    return batch.rotations, kin.forward(batch.rotations)


def thigh_angles(rotations):
    """Degrees above (+) or below (-) the horizontal, [n, 2]."""
    down = torch.stack([-segment(rotations, f"{s}_thigh")[:, 2, 2] for s in ("right", "left")], 1)
    return torch.asin(down.clamp(-1, 1)).rad2deg()


@pytest.fixture(scope="module")
def many():
    return sample_poses(1200, generator(1))


def test_rotations_are_rotations(many):
    r = many.rotations
    assert r.shape == (1200, 21, 3, 3) and r.dtype == torch.float32
    torch.testing.assert_close(r @ r.mT, torch.eye(3).expand_as(r), atol=2e-5, rtol=0)
    assert (torch.linalg.det(r) > 0.999).all()


def test_shares_and_names(many):
    assert tuple(ACTIVITIES) == NAMES and math.isclose(sum(ACTIVITIES.values()), 1.0, abs_tol=1e-6)
    for name, share in ACTIVITIES.items():
        assert many.names.count(name) / 1200 == pytest.approx(share, abs=0.04)


def test_postures_are_human(many):
    assert within_limits(many.rotations).float().mean() > 0.995
    assert (many.clash > 0.05).float().mean() < 0.02


def test_canonical_posture_is_within_limits_and_wrong_joints_are_not():
    rest = torch.eye(3).expand(1, len(SEGMENTS), 3, 3).clone()
    assert within_limits(rest).all()

    def bent(names, axis, degrees):
        pose = rest.clone()
        for name in names:
            pose[:, SEGMENT[name]] = kin.rot(axis, torch.tensor(math.radians(degrees)))
        return bool(within_limits(pose)[0])

    right_arm = [f"right_{s}" for s in ("forearm", "hand", "fingers")]
    left_arm = [f"left_{s}" for s in ("forearm", "hand", "fingers")]
    assert bent(right_arm, 2, 90) and not bent(right_arm, 2, -40) and not bent(right_arm, 2, 170)
    assert bent(left_arm, 2, -90) and not bent(left_arm, 2, 40)
    assert bent(["left_shin", "left_foot"], 0, 90) and not bent(["left_shin", "left_foot"], 0, -30)
    assert bent(["head"], 2, 70) and not bent(["head"], 2, 120)
    assert not bent(["right_thigh", "right_shin", "right_foot"], 0, 80)


def test_same_generator_same_postures():
    a, b, c = sample_poses(40, generator(5)), sample_poses(40, generator(5)), sample_poses(40, generator(6))
    assert torch.equal(a.rotations, b.rotations) and a.names == b.names
    assert not torch.equal(a.rotations, c.rotations)


@pytest.mark.parametrize("mix", [{"dancing": 1.0}, {}, {"walking": 0.0}, {"walking": -1.0, "sitting": 2.0}])
def test_bad_mix(mix):
    with pytest.raises(UnderstudyError):
        sample_poses(3, generator(), mix=mix)


def test_nobody_at_all():
    assert sample_poses(0, generator()).rotations.shape == (0, 21, 3, 3)


def test_people_face_ahead(many):
    upright = torch.tensor([name != "lying" for name in many.names])
    left = segment(many.rotations, "pelvis")[upright][:, :, 0]
    assert (torch.atan2(left[:, 1], left[:, 0]).abs() < math.radians(40)).all()


def test_left_and_right_are_treated_alike(many):
    a = kin.forward(many.rotations).mean(0)
    b = kin.forward(kin.mirror(many.rotations)).mean(0)
    assert (a - b).abs().max() < 0.05


@pytest.mark.parametrize("activity", ["standing", "arms_crossed", "reaching", "opening", "carrying", "raised"])
def test_feet_are_level_on_the_ground(activity):
    rotations, origins = only(activity)
    ankles = origins[:, [SEGMENT["right_foot"], SEGMENT["left_foot"]], 2]
    assert ((ankles[:, 0] - ankles[:, 1]).abs() < 0.16).float().mean() > 0.9
    up = torch.stack([segment(rotations, f"{s}_foot")[:, 2, 2] for s in ("right", "left")])
    assert (up > math.cos(math.radians(62))).all()


def test_sitting():
    rotations, _ = only("sitting")
    angles = thigh_angles(rotations)
    assert ((angles > -45) & (angles < 40)).float().mean() > 0.97
    assert angles.mean().abs() < 15


def test_standing_is_upright():
    rotations, _ = only("standing")
    assert (thigh_angles(rotations) < -45).float().mean() > 0.97
    assert (segment(rotations, "chest")[:, 2, 2] > 0.85).float().mean() > 0.97


def test_arms_crossed():
    rotations, origins = only("arms_crossed")
    chest, middle = segment(rotations, "chest"), origins[:, SEGMENT["chest"]]
    for side, sign in (("right", 1.0), ("left", -1.0)):
        wrist = kin.turn(chest.mT, origins[:, SEGMENT[f"{side}_hand"]] - middle)
        assert (sign * wrist[:, 0] > 0).float().mean() > 0.97
        assert (wrist[:, 1] < -0.1).all()


def test_raised():
    _, origins = only("raised")
    above = [origins[:, SEGMENT[f"{s}_hand"], 2] - origins[:, SEGMENT[f"{s}_upper_arm"], 2] for s in ("right", "left")]
    assert (torch.stack(above).amax(0) > -0.05).float().mean() > 0.85


def test_bending():
    rotations, _ = only("bending")
    lean = torch.atan2(-segment(rotations, "chest")[:, 1, 2], segment(rotations, "chest")[:, 2, 2]).rad2deg()
    assert ((lean > 25) & (lean < 120)).float().mean() > 0.97
    assert lean.quantile(0.9) > 80


def test_crouching_is_low():
    rotations, origins = only("crouching")
    assert (-kin.lowest(rotations, origins) < 0.78).float().mean() > 0.95


def test_lying():
    rotations, _ = only("lying")
    assert (segment(rotations, "chest")[:, 2, 2].abs() < 0.5).all()


def test_opening_has_a_hand_at_handle_height():
    rotations, origins = only("opening")
    floor = kin.lowest(rotations, origins)
    hands = torch.stack([origins[:, SEGMENT[f"{s}_hand"], 2] for s in ("right", "left")]) - floor
    assert ((hands > 0.5) & (hands < 1.45)).any(0).float().mean() > 0.97


def test_reaching_goes_everywhere():
    _, origins = only("reaching", 300)
    wrist = origins[:, SEGMENT["right_hand"]] - origins[:, SEGMENT["right_upper_arm"]]
    assert wrist[:, 2].quantile(0.97) > 0.25 and wrist[:, 2].quantile(0.05) < -0.45
    assert wrist[:, 1].quantile(0.03) < -0.4 and wrist[:, 1].quantile(0.97) > 0.1
    assert wrist[:, 0].quantile(0.05) < -0.3 and wrist[:, 0].quantile(0.95) > 0.1


def test_walking_alternates_legs_and_repeats():
    motion = sequence(90, generator(2), "walking", fps=30)
    ahead = torch.stack([segment(motion, f"{s}_thigh")[:, 1, 2] for s in ("right", "left")])
    leads = (ahead[0] > ahead[1]).int().diff().abs().sum()
    assert 4 <= leads <= 9
    assert torch.corrcoef(ahead)[0, 1] < -0.5
    batch = sample_poses(200, generator(2), mix={"walking": 1.0}).rotations
    both = torch.stack([segment(batch, f"{s}_thigh")[:, 1, 2] for s in ("right", "left")])
    assert torch.corrcoef(both)[0, 1] < -0.3


@pytest.mark.parametrize("activity", [None, *ACTIVITIES])
def test_sequences_are_smooth(activity):
    motion = sequence(45, generator(4), activity, fps=30)
    assert motion.shape == (45, 21, 3, 3)
    step = kin.angle_of(motion[1:].mT @ motion[:-1]).rad2deg()
    assert step.max() < 32
    assert step.max() > 0.5
    torch.testing.assert_close(motion @ motion.mT, torch.eye(3).expand_as(motion), atol=1e-4, rtol=0)


def test_sequence_arguments():
    assert sequence(1, generator(), "standing").shape == (1, 21, 3, 3)
    for bad in ({"n_frames": 0}, {"n_frames": 3, "fps": 0.0}, {"n_frames": 3, "activity": "dancing"}):
        with pytest.raises(UnderstudyError):
            sequence(generator=generator(), **bad)


def test_interpolation_meets_its_ends(many):
    a, b = many.rotations[:300], many.rotations[300:600]
    torch.testing.assert_close(interpolate(a, b, 0.0), a, atol=2e-4, rtol=0)
    torch.testing.assert_close(interpolate(a, b, 1.0), b, atol=5e-3, rtol=0)
    mid = interpolate(a, b, torch.full((300,), 0.5))
    torch.testing.assert_close(mid @ mid.mT, torch.eye(3).expand_as(mid), atol=1e-4, rtol=0)
    elbow = {k: v for k, v in kin.limit_excess(mid).items() if k.endswith("elbow")}
    assert (torch.stack(list(elbow.values())) < 0.1).float().mean() > 0.9


def test_quaternions_round_trip(many):
    r = many.rotations.flatten(0, 1)
    torch.testing.assert_close(kin.from_quaternion(kin.to_quaternion(r)), r, atol=1e-4, rtol=0)


def test_inverse_kinematics_reaches_its_target():
    g = generator(7)
    rotations = torch.eye(3).expand(500, 21, 3, 3).clone()
    direction = kin.unit(torch.randn(500, 3, generator=g))
    distance = 0.2 + 0.34 * torch.rand(500, 1, generator=g)
    start = kin.forward(rotations)[:, SEGMENT["right_upper_arm"]]
    goal = start + direction * distance
    upper, fore = kin.arm_frames(
        *kin.two_bone(start, goal, torch.randn(500, 3, generator=g), kin.UPPER_ARM, kin.FOREARM)
    )
    rotations[:, SEGMENT["right_upper_arm"]], rotations[:, SEGMENT["right_forearm"]] = upper, fore
    torch.testing.assert_close(kin.forward(rotations)[:, SEGMENT["right_hand"]], goal, atol=2e-5, rtol=0)
    bend = (upper.mT @ fore)[:, 1, 0]
    assert (bend > -1e-4).all()  # the elbow bends the right way
    hip = kin.forward(rotations)[:, SEGMENT["left_thigh"]]
    goal = hip + direction * (0.3 + 0.5 * torch.rand(500, 1, generator=g))
    thigh, shin = kin.leg_frames(*kin.two_bone(hip, goal, torch.randn(500, 3, generator=g), kin.THIGH, kin.SHIN))
    rotations[:, SEGMENT["left_thigh"]], rotations[:, SEGMENT["left_shin"]] = thigh, shin
    torch.testing.assert_close(kin.forward(rotations)[:, SEGMENT["left_foot"]], goal, atol=2e-5, rtol=0)
    assert ((thigh.mT @ shin)[:, 1, 2] < 1e-4).all()


def test_mirror_twice_is_the_same(many):
    assert torch.equal(kin.mirror(kin.mirror(many.rotations)), many.rotations)
    a, b = kin.forward(many.rotations), kin.forward(kin.mirror(many.rotations))
    torch.testing.assert_close(a[:, kin.MIRROR_SEGMENTS] * FLIP, b, atol=1e-5, rtol=0)
