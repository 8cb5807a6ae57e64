"""Laws that the simulated bodies, their posing and their clothes keep."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from understudy.errors import UnderstudyError  # noqa: E402
from understudy.skeleton import JOINT  # noqa: E402
from understudy.synthetic import ansur, bodies, carried, clothing  # noqa: E402
from understudy.synthetic.bodies import REGION, BodyBank, pose, pose_extra  # noqa: E402
from understudy.synthetic.segments import PARENTS, SEGMENT, SEGMENTS  # noqa: E402

N, P = 4, 1500


@pytest.fixture(scope="module", params=["capsules", "anny"])
def bank(request: pytest.FixtureRequest) -> BodyBank:
    """A small bank of each kind."""
    if request.param == "anny":
        pytest.importorskip("anny")
        return bodies.anny_bank(N, 0, P)
    return bodies.capsule_bank(N, 0, P)


def random_rotations(*shape: int, seed: int = 0) -> torch.Tensor:
    """Uniform random rotation matrices."""
    q, r = torch.linalg.qr(torch.randn(*shape, 3, 3, generator=torch.Generator().manual_seed(seed)))
    q = q * r.diagonal(dim1=-2, dim2=-1).sign()[..., None, :]
    return q * torch.linalg.det(q)[..., None, None]


def everybody(bank: BodyBank) -> torch.Tensor:
    return torch.arange(len(bank))


def test_fields_are_sound(bank: BodyBank) -> None:
    assert torch.allclose(bank.weights.sum(1), torch.ones(P), atol=1e-5)
    assert torch.allclose(bank.helper_weights.sum(1), torch.ones(P), atol=1e-5)
    assert bank.helper_weights.min() > -1e-6
    assert torch.allclose(bank.normals.norm(dim=2), torch.ones(N, P), atol=1e-4)
    assert torch.allclose(bank.align @ bank.align.mT, torch.eye(3).expand_as(bank.align), atol=1e-5)
    assert bank.along.min() >= 0 and bank.along.max() <= 1
    assert set(bank.region.tolist()) == set(REGION.values())
    assert bank.origins[:, 0].abs().max() < 1e-6
    hips = bank.joints[:, [JOINT["right_hip"], JOINT["left_hip"]]].mean(1)
    assert hips.abs().max() < 1e-5
    for i, name in enumerate(SEGMENTS):  # the person's left is +x
        if name.startswith(("left", "right")):
            assert ((bank.origins[:, i, 0] > 0) == name.startswith("left")).all()
    assert (bank.joints[:, JOINT["nose"], 1] < bank.joints[:, JOINT["left_ear"], 1]).all()  # faces -y


def test_canonical_posture(bank: BodyBank) -> None:
    posed = pose(bank, everybody(bank), torch.eye(3).expand(N, len(SEGMENTS), 3, 3))
    for side, x in (("right", -1.0), ("left", 1.0)):
        for part, child, goal in (
            ("upper_arm", "forearm", (x, 0, 0)),
            ("forearm", "hand", (x, 0, 0)),
            ("hand", "fingers", (x, 0, 0)),
            ("thigh", "shin", (0, 0, -1)),
            ("shin", "foot", (0, 0, -1)),
        ):
            bone = posed.origins[:, SEGMENT[f"{side}_{child}"]] - posed.origins[:, SEGMENT[f"{side}_{part}"]]
            unit = torch.nn.functional.normalize(bone, dim=1)
            assert torch.allclose(unit, torch.tensor(goal).float().expand(N, 3), atol=1e-4)
    tall = posed.points[..., 2].amax(1) - posed.points[..., 2].amin(1)
    assert (tall - bank.stature).abs().max() < 0.02  # the legs are straighter than at rest, and points miss the crown


def test_rest_pose_is_recovered(bank: BodyBank) -> None:
    posed = pose(bank, everybody(bank), bank.align.mT)
    for got, rest in (
        (posed.points, bank.points),
        (posed.normals, bank.normals),
        (posed.joints, bank.joints),
        (posed.origins, bank.origins),
    ):
        assert torch.allclose(got, rest, atol=1e-5)


def test_turning_all_segments_moves_everything_rigidly(bank: BodyBank) -> None:
    turn = random_rotations(N)
    posed = pose(bank, everybody(bank), turn[:, None] @ bank.align.mT)
    assert torch.allclose(posed.points, bank.points @ turn.mT, atol=1e-5)
    assert torch.allclose(posed.normals, bank.normals @ turn.mT, atol=1e-5)
    assert torch.allclose(posed.joints, bank.joints @ turn.mT, atol=1e-5)


def test_bones_keep_their_lengths(bank: BodyBank) -> None:
    posed = pose(bank, everybody(bank), random_rotations(N, len(SEGMENTS)))
    child = torch.arange(1, len(SEGMENTS))
    parent = torch.tensor(PARENTS[1:])
    now = (posed.origins[:, child] - posed.origins[:, parent]).norm(dim=2)
    rest = (bank.origins[:, child] - bank.origins[:, parent]).norm(dim=2)
    assert torch.allclose(now, rest, atol=1e-5)
    ends = posed.joints[:, [JOINT["right_shoulder"], JOINT["left_shoulder"]]]
    assert torch.allclose(posed.joints[:, JOINT["neck"]], ends.mean(1), atol=1e-6)


def test_a_turned_hand_does_not_wring_the_wrist(bank: BodyBank) -> None:
    rotations = torch.eye(3).expand(N, len(SEGMENTS), 3, 3).clone()
    flat = pose(bank, everybody(bank), rotations)
    for part in ("hand", "fingers"):
        rotations[:, SEGMENT[f"right_{part}"]] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    turned = pose(bank, everybody(bank), rotations)
    lower = (bank.segment == SEGMENT["right_forearm"]) & (bank.along > 0.5)
    elbow = flat.origins[:, SEGMENT["right_forearm"], None, 1:]

    def radius(points: torch.Tensor) -> torch.Tensor:
        return (points[:, lower, 1:] - elbow).norm(dim=2).mean(1)

    assert (radius(turned.points) / radius(flat.points)).min() > 0.75


def test_joints_lie_inside_the_body(bank: BodyBank) -> None:
    for kind, part in (
        ("shoulder", "upper_arm"),
        ("elbow", "forearm"),
        ("wrist", "forearm"),
        ("hip", "thigh"),
        ("knee", "shin"),
        ("ankle", "shin"),
    ):
        for side in ("right", "left"):
            limb = bank.weights[:, SEGMENT[f"{side}_{part}"]] > 0.4
            gap = bank.joints[:, JOINT[f"{side}_{kind}"], None] - bank.points[:, limb]
            distance, nearest = gap.norm(dim=2).min(1)
            rows = torch.arange(N)
            inward = -torch.nn.functional.normalize(gap[rows, nearest], dim=1) * bank.normals[:, limb][rows, nearest]
            assert distance.max() < 0.16
            assert inward.sum(1).min() > 0.3
    face = bank.joints[:, [JOINT["nose"], JOINT["left_eye"], JOINT["right_ear"]]]
    assert (face[:, :, None] - bank.points[:, None]).norm(dim=3).amin(2).max() < 0.045


def test_hips_are_where_annotators_put_them(bank: BodyBank) -> None:
    posed = pose(bank, everybody(bank), bank.align.mT)
    apart = (posed.joints[:, JOINT["right_hip"]] - posed.joints[:, JOINT["left_hip"]]).norm(dim=1)
    assert 0.2 < apart.mean() < 0.25


def test_statures_follow_ansur() -> None:
    g = torch.Generator().manual_seed(3)
    female = ansur.draw_sex(4000, g)
    stature = ansur.draw_stature(female, g)
    lengths = ansur.draw_lengths(female, stature, g)
    for sex in (0, 1):
        pick = female == bool(sex)
        assert pick.sum() == 2000
        mean, sd = ansur.STATURE[sex]
        assert abs(stature[pick].mean() - mean) < 0.006 and abs(stature[pick].std() - sd) < 0.006
        for name, numbers in ansur.LENGTHS.items():
            mean, sd = numbers[2 * sex], numbers[2 * sex + 1]
            assert abs(lengths[name][pick].mean() - mean) < 0.1 * sd + 0.001
            assert abs(lengths[name][pick].std() / sd - 1) < 0.12


def test_capsule_bodies_have_these_statures() -> None:
    bank = bodies.capsule_bank(120, 1, 400)
    posed = pose(bank, everybody(bank), torch.eye(3).expand(120, len(SEGMENTS), 3, 3))
    tall = posed.points[..., 2].amax(1) - posed.points[..., 2].amin(1)
    for sex, (mean, sd) in enumerate(ansur.STATURE):
        pick = bank.female == bool(sex)
        assert abs(bank.stature[pick].mean() - mean) < 0.02 and abs(bank.stature[pick].std() - sd) < 0.02
    assert (tall - bank.stature).abs().max() < 0.03
    bone = bank.origins[:, SEGMENT["right_upper_arm"]] - bank.origins[:, SEGMENT["left_upper_arm"]]
    assert abs(bone.norm(dim=1)[~bank.female].mean() - (0.416 - 2 * ansur.SHOULDER_IN)) < 0.01


def test_same_seed_same_bodies() -> None:
    a, b, c = (bodies.capsule_bank(4, seed, 300) for seed in (5, 5, 6))
    for f in dataclasses.fields(a):
        assert torch.equal(getattr(a, f.name), getattr(b, f.name))
    assert not torch.equal(a.points, c.points)


def test_file_round_trip(tmp_path: Path) -> None:
    bank = bodies.load_bank("capsules", 3, 0, cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    again = bodies.load_bank("capsules", 3, 0, cache=tmp_path)
    for f in dataclasses.fields(bank):
        assert torch.equal(getattr(bank, f.name), getattr(again, f.name))
    some = again.select([2, 0])
    assert torch.equal(some.points[0], bank.points[2]) and torch.equal(some.weights, bank.weights)
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(b"no bodies")
    with pytest.raises(UnderstudyError, match="broken"):
        BodyBank.load(broken)
    with pytest.raises(UnderstudyError, match="anny"):
        bodies.load_bank("clay", 1, 0, cache=tmp_path)


def dressed(bank: BodyBank, seed: int, n: int = 24) -> tuple[torch.Tensor, clothing.Style, clothing.Dressed]:
    ids = torch.arange(n) % len(bank)
    style = clothing.draw_style(bank, ids, torch.Generator().manual_seed(seed))
    return ids, style, clothing.dress(bank, ids, torch.Generator().manual_seed(seed + 1), style)


def test_clothes_lie_outside_and_leave_face_and_hands_bare(bank: BodyBank) -> None:
    ids, _style, worn = dressed(bank, 0)
    shift = worn.points - bank.points[ids]
    outward = (shift * bank.normals[ids]).sum(2)
    legs = (bank.region == REGION["thigh"]) | (bank.region == REGION["shin"])  # skirts have a shape of their own
    assert outward[:, ~legs].min() > -0.01
    plain = worn.bridge.amax(1) == 0
    assert outward[plain].min() > -0.01
    bare = (bank.region == REGION["head_skin"]) | (bank.region == REGION["hand"])
    assert shift[:, bare].abs().max() == 0
    assert not worn.dark[:, bare].any()
    assert shift.norm(dim=2).max() < 0.35
    assert torch.allclose(worn.normals.norm(dim=2), torch.ones(()), atol=1e-3)
    assert worn.points.isfinite().all()


def test_dressing_is_deterministic(bank: BodyBank) -> None:
    a, b, c = (dressed(bank, seed)[2] for seed in (0, 0, 9))
    for f in dataclasses.fields(a):
        assert torch.equal(getattr(a, f.name).nan_to_num(), getattr(b, f.name).nan_to_num())
    assert not torch.equal(a.points, c.points)


def test_a_skirt_closes_the_gap_between_the_legs(bank: BodyBank) -> None:
    ids, style, _ = dressed(bank, 0)
    one = torch.ones(len(ids))
    style = dataclasses.replace(
        style, skirt=one > 0, coat=one < 0, bottom_hem=1.2 * one, folds=0 * one, top_hem=0 * one
    )
    worn = clothing.dress(bank, ids, torch.Generator().manual_seed(0), style)
    rotations = torch.eye(3).expand(len(ids), len(SEGMENTS), 3, 3)
    posed = pose(bank, ids, rotations, worn.points, worn.normals, worn.bridge)
    knee = posed.joints[:, JOINT["right_knee"], None]
    middle = (posed.points[..., 0].abs() < 0.04) & ((posed.points[..., 2] - knee[..., 2] - 0.08).abs() < 0.06)
    front = middle & (posed.points[..., 1] < knee[..., 1] - 0.05)
    assert (front.sum(1) >= 2).all()  # something hangs there


def test_carried_things_are_rigid_to_their_segment(bank: BodyBank) -> None:
    ids, _style, worn = dressed(bank, 0)
    assert worn.extra.shape == (len(ids), carried.N_EXTRA, 3)
    there = ~worn.extra[:, : carried.N_THING].isnan().any(2)
    assert torch.equal(there.any(1), worn.carried > 0)
    posed = pose(bank, ids, bank.align[ids].mT)
    back = pose_extra(bank, ids, posed, worn.extra, worn.extra_segment)
    assert torch.allclose(back, worn.extra, atol=1e-5, equal_nan=True)
    posed = pose(bank, ids, random_rotations(len(ids), len(SEGMENTS)))
    moved = pose_extra(bank, ids, posed, worn.extra, worn.extra_segment)
    for i in (worn.carried > 0).nonzero()[:, 0]:
        a, b = (x[i, : carried.N_THING][there[i]][:50] for x in (worn.extra, moved))
        assert torch.allclose((a[:, None] - a).norm(dim=2), (b[:, None] - b).norm(dim=2), atol=1e-5)


def test_the_drawn_lengths_are_those_of_the_bodies() -> None:
    pytest.importorskip("anny")
    bank = bodies.anny_bank(24, 2, 300)
    spans = (
        ("upper_arm", "forearm", 0.277),
        ("forearm", "hand", 0.257),
        ("thigh", "shin", 0.394),
        ("shin", "foot", 0.411),
    )
    for part, child, mean in spans:  # the mean of both sexes by ANSUR
        bone = bank.origins[:, SEGMENT[f"left_{child}"]] - bank.origins[:, SEGMENT[f"left_{part}"]]
        assert abs(bone.norm(dim=1).mean() - mean) < 0.015
    tall = bank.points[..., 2].amax(1) - bank.points[..., 2].amin(1)
    assert (tall - bank.stature).abs().max() < 0.04
