"""The voxel method as a whole, with the weights that come with the package."""

import hashlib
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from understudy import methods, recordings, voxels
from understudy.errors import UnderstudyError
from understudy.floor import Floor, measured_floor
from understudy.registration import register
from understudy.roots import Root
from understudy.skeleton import FLIP, JOINT, TORSO
from understudy.types import Keypoints2D, Person, RegisteredDepth, RegisteredFrame
from understudy.voxel_lifting import VoxelLifter, choose, pooled


@pytest.fixture(scope="module")
def scene():
    """The bundled recording's third frame and its true 2D keypoints; of hidden joints, too."""
    recording = recordings.open("sample")
    frame = register(recording.frame(2))
    truth = recording.truth.frames[2]
    seen = [Keypoints2D.where(frame.camera.project(t.keypoints), np.where(t.occluded, 0.4, 0.9)) for t in truth]
    return frame, truth, seen


def error(person, truth) -> np.ndarray:
    return np.linalg.norm(person.keypoints - truth.keypoints, axis=1)


def test_hidden_joints_are_found(scene):
    frame, truth, seen = scene
    for person, true in zip(VoxelLifter().lift(frame, seen), truth, strict=True):
        assert error(person, true)[true.occluded].mean() < 0.1
        assert error(person, true)[~true.occluded].mean() < 0.05


def test_every_frame_every_run_the_same_bits(tmp_path):
    """A simulated sequence, lifted twice in processes of their own."""
    pytest.importorskip("torch")
    from understudy.synthetic.recording import RecordingConfig, write_synthetic

    write_synthetic(tmp_path / "r", 4, 7, RecordingConfig(bodies="capsules", body_count=4, sequence=True))
    code = f"""if True:
        import hashlib
        from understudy import Estimator, detectors, recordings
        recording = recordings.open({str(tmp_path / "r")!r})
        estimator = Estimator(detector=detectors.create("recording", recording), hands="depth")
        digest = hashlib.sha256()
        for frame in recording:
            for person in estimator.estimate(frame):
                digest.update(person.keypoints.tobytes() + person.sigma_m.tobytes() + person.confidence.tobytes())
                digest.update(b"".join(p.normal.tobytes() for p in person.hands.values() if p is not None))
        print(digest.hexdigest())
    """
    runs = [subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True) for _ in range(2)]
    assert runs[0].stdout == runs[1].stdout and len(runs[0].stdout) == 65
    nothing = hashlib.sha256().hexdigest()
    assert nothing not in runs[0].stdout


def test_people_do_not_depend_on_each_other(scene):
    frame, _, seen = scene
    together = VoxelLifter().lift(frame, seen)
    alone = [VoxelLifter().lift(frame, [p])[0] for p in seen]
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_allclose(a.keypoints, b.keypoints, atol=1e-6)


def test_something_before_the_trunk_does_not_take_the_root(scene):
    """A board, half a metre before the camera, over most of a person's trunk: the paper's root would lie on it."""
    frame, truth, seen = scene
    z = frame.depth.z.copy()
    uv = seen[1].uv * frame.depth.scale_to(frame.camera)
    (left, top), (right, bottom) = uv[[2, 5, 8, 11]].min(0).astype(int) - 8, uv[[2, 5, 8, 11]].max(0).astype(int) + 8
    middle = (top + 2 * bottom) // 3
    z[top:middle, left:right] = 0.5
    blocked = RegisteredFrame(frame.color, frame.camera, RegisteredDepth(z, frame.depth.camera), 2)
    person = VoxelLifter().lift(blocked, [seen[1]])[0]
    assert np.median(error(person, truth[1])) < 0.2
    neck = seen[1].uv[JOINT["neck"]] * frame.depth.scale_to(frame.camera)
    assert z[int(neck[1]), int(neck[0])] == np.float32(0.5)


def test_people_are_looked_at_again_from_their_trunk(scene, monkeypatch):
    """The first look is from the root, the second from where the trunk was found, in a mirror; both are pooled."""
    frame, _, seen = scene
    once, twice = VoxelLifter(second_looks=0), VoxelLifter(second_looks=2)
    looks: list[list[np.ndarray]] = []
    lift = VoxelLifter._lift

    def spied(self, frame, cloud, floor, each, mirrored=False):
        assert mirrored == (len(looks) % 2 == 1)  # every second call
        looks.append([root.point for _, root in each])
        return lift(self, frame, cloud, floor, each, mirrored)

    monkeypatch.setattr(VoxelLifter, "_lift", spied)
    first = once.lift(frame, seen)
    assert [len(each) for each in looks] == [len(looks[0]), 0]
    looks.clear()
    both = twice.lift(frame, seen)
    np.testing.assert_allclose(looks[1], [p.keypoints[TORSO].mean(0) for p in first])
    floor = measured_floor(voxels.cloud(frame.depth, voxels.ENOUGH))
    for person, point, a, b in zip(seen, looks[1], first, both, strict=True):
        cloud = voxels.cloud(frame.depth, voxels.ENOUGH)
        (second,) = lift(twice, frame, cloud, floor, [(person, Root(point, 1.0, "depth"))], mirrored=True)
        assert np.abs(second.keypoints - a.keypoints).max() > 1e-3
        np.testing.assert_allclose(b.keypoints, pooled(a, second).keypoints, atol=1e-4)
    less_sure = min((0, 1), key=lambda k: first[k].confidence.mean())
    one = VoxelLifter(second_looks=1).lift(frame, seen)
    np.testing.assert_array_equal(one[1 - less_sure].keypoints, first[1 - less_sure].keypoints)
    np.testing.assert_allclose(one[less_sure].keypoints, both[less_sure].keypoints, atol=1e-4)
    nobody = VoxelLifter(second_looks=0).lift(frame, seen)
    assert all((a.keypoints == b.keypoints).all() for a, b in zip(first, nobody, strict=True))


def test_a_mirrored_look_is_a_look_at_the_mirror_image(scene):
    frame, _, seen = scene
    lifter, cloud = VoxelLifter(), voxels.cloud(frame.depth, voxels.ENOUGH)
    floor = measured_floor(cloud)
    point = lifter.lift(frame, seen)[1].keypoints[TORSO].mean(0) + 0.03
    (got,) = lifter._lift(frame, cloud, floor, [(seen[1], Root(point, 1.0, "depth"))], mirrored=True)
    (plain,) = lifter._lift(frame, cloud, floor, [(seen[1], Root(point, 1.0, "depth"))])

    to = np.array([-1.0, 1.0, 1.0])
    K = frame.camera.K.copy()
    K[0, 2] = frame.camera.width - 1 - K[0, 2]
    there = RegisteredFrame(frame.color[:, ::-1], replace(frame.camera, K=K), frame.depth, 0)
    uv = np.column_stack([frame.camera.width - 1 - seen[1].uv[:, 0], seen[1].uv[:, 1]])[FLIP]
    person = Keypoints2D(np.where(seen[1].found[FLIP, None], uv, seen[1].uv[FLIP]), seen[1].score[FLIP])
    assert floor is not None
    other = Floor(floor.up * to, floor.height)
    (want,) = lifter._lift(there, cloud * to.astype(np.float32), other, [(person, Root(point * to, 1.0, "depth"))])
    np.testing.assert_allclose(got.keypoints, want.keypoints[FLIP] * to, atol=1e-4)
    np.testing.assert_allclose(got.confidence, want.confidence[FLIP], atol=1e-4)
    np.testing.assert_allclose(got.sigma_m, want.sigma_m[FLIP], atol=1e-4)
    assert got.source == tuple(want.source[k] for k in FLIP)
    assert np.abs(got.keypoints - plain.keypoints).max() > 1e-3


def test_pooled_looks_are_weighted_by_their_certainty():
    (a, _), (b, _) = at(2.0, 0.9, 1.0), at(2.3, 0.6, 1.0)
    a.sigma_m[:] = 0.05
    one = pooled(a, b)
    np.testing.assert_allclose(one.keypoints[:, 2], 2.0 * 0.8 + 2.3 * 0.2)
    np.testing.assert_allclose(one.confidence, 0.9 * 0.8 + 0.6 * 0.2)
    np.testing.assert_allclose(one.sigma_m, 0.95 * (0.05 * 0.8 + 0.1 * 0.2))  # two looks err less than one
    assert one.source == a.source and one.keypoints_2d is a.keypoints_2d


def at(z: float, confidence: float, support: float) -> tuple[Person, Root]:
    """Somebody whom the network puts at distance z, and the place that it was shown."""
    joints = np.zeros((18, 3)) + (0.0, 0.0, z)
    nothing = Keypoints2D(np.zeros((18, 2)), np.zeros(18))
    person = Person(nothing, joints, np.full(18, confidence), np.full(18, 0.1), ("observed",) * 18)
    return person, Root(np.array([0.0, 0.0, z]), support, "depth")


def places(*several: tuple[Person, Root]) -> tuple[list[Person], list[Root]]:
    people, roots = zip(*several, strict=True)
    return list(people), list(roots)


def chosen(*everybody: tuple[list[Person], list[Root]]) -> list[int | None]:
    return choose([people for people, _ in everybody], [roots for _, roots in everybody])


def test_of_two_places_the_network_and_the_depths_decide():
    assert chosen(places(at(2, 0.9, 0.4), at(3, 0.5, 0.4))) == [0]
    assert chosen(places(at(2, 0.6, 0.1), at(3, 0.6, 0.8))) == [1]
    assert chosen(places(at(2, 0.9, 0.2), at(3, 0.5, 0.8))) == [0]  # the network's word weighs more
    assert chosen(([], []), places(at(2, 0.1, 0.0))) == [None, 0]


def test_two_people_do_not_get_one_place():
    sure = places(at(2, 0.9, 0.9))
    torn = places(at(2.1, 0.62, 0.3), at(3, 0.6, 0.3))
    assert chosen(torn) == [0]
    assert chosen(torn, sure) == [1, 0] and chosen(sure, torn) == [0, 1]
    assert chosen(places(at(2.1, 0.6, 0.3)), sure) == [0, 0]  # there is no other


def test_nobody_and_nothing(scene):
    frame, *_ = scene
    assert VoxelLifter().lift(frame, []) == []
    (person,) = VoxelLifter().lift(frame, [Keypoints2D(np.zeros((18, 2)), np.zeros(18))])
    assert person.failed == "no usable 2D keypoint" and np.isnan(person.keypoints).all()


def test_wrong_names(tmp_path):
    with pytest.raises(UnderstudyError, match="assembly 'glue': must be one of 'uncertainty', 'paper', 'network'"):
        VoxelLifter(assembly="glue")
    with pytest.raises(UnderstudyError, match="second_looks -1: must be 0 or more"):
        VoxelLifter(second_looks=-1)
    with pytest.raises(UnderstudyError, match="method 'naive' has none"):
        methods.create("naive", weights=tmp_path / "x.onnx")
    with pytest.raises(UnderstudyError, match="no such file"):
        VoxelLifter(weights=tmp_path / "x.onnx")
