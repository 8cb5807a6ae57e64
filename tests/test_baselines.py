"""Naive lifting with offsets; the MLP baseline."""

from __future__ import annotations

import numpy as np
import pytest

from understudy import baselines
from understudy.baselines import (
    OFFSETS_M,
    MlpLifter,
    MlpPredictor,
    NaiveOffsetLifter,
    fit_offsets,
    fit_offsets_on,
    grid_depths,
    kind,
    mirrored,
    mlp_input,
)
from understudy.errors import ModelFileError, UnderstudyError
from understudy.lifting import NaiveLifter
from understudy.recordings import open as open_recording
from understudy.recordings import write_recording
from understudy.recordings.truth import Truth, TruthPerson
from understudy.registration import register
from understudy.skeleton import JOINT, JOINTS, N_JOINTS
from understudy.types import Keypoints2D
from understudy.voxels import CELL, EMPTY, HALF

KNOWN = {k: 0.01 * (i + 1) for i, k in enumerate(OFFSETS_M)}
"""kind of joint -> metres"""


def standing(u: float = 480.0) -> Keypoints2D:
    """Someone about 2 m away, before the wall of `flat_frame`."""
    places = {
        "nose": (0, 60), "neck": (0, 120), "shoulder": (45, 125), "elbow": (60, 200), "wrist": (65, 270),
        "hip": (28, 260), "knee": (30, 370), "ankle": (32, 470), "eye": (8, 52), "ear": (16, 58),
    }  # fmt: skip
    uv = [(u + (1 if n.startswith("left") else -1) * places[kind(n)][0], places[kind(n)][1]) for n in JOINTS]
    return Keypoints2D(np.array(uv, float), np.full(N_JOINTS, 0.9))


def test_every_kind_of_joint_has_an_offset():
    assert {kind(name) for name in JOINTS} == set(OFFSETS_M)
    assert all(0 <= v < 0.2 for v in OFFSETS_M.values()) and OFFSETS_M["hip"] > OFFSETS_M["wrist"] > OFFSETS_M["eye"]


def test_offsets_lie_along_the_ray(flat_frame):
    frame, seen = register(flat_frame), standing()
    (naive,), (moved,) = NaiveLifter().lift(frame, [seen]), NaiveOffsetLifter(offsets_m=KNOWN).lift(frame, [seen])
    wanted = np.array([KNOWN[kind(name)] for name in JOINTS])
    np.testing.assert_allclose(
        np.linalg.norm(moved.keypoints, axis=1) - np.linalg.norm(naive.keypoints, axis=1), wanted
    )
    np.testing.assert_allclose(frame.camera.project(moved.keypoints), seen.uv, atol=1e-6)
    np.testing.assert_array_equal(moved.confidence, naive.confidence)


def test_fitted_offsets_are_exact_on_a_wall(flat_frame, tmp_path):
    frame, seen = register(flat_frame), standing()
    (true,) = NaiveOffsetLifter(offsets_m=KNOWN).lift(frame, [seen])
    occluded = np.zeros(N_JOINTS, bool)
    occluded[JOINT["left_knee"]] = True
    keypoints = true.keypoints.copy()
    keypoints[JOINT["left_knee"]] += 3.0  # hidden: must not count
    truth = Truth({0: (TruthPerson(0, keypoints, np.ones(N_JOINTS, bool), occluded),)})
    write_recording(tmp_path / "wall", [flat_frame], truth=truth)
    assert fit_offsets_on([open_recording(tmp_path / "wall")]) == pytest.approx(KNOWN, abs=6e-4)


def test_a_kind_that_nobody_shows_gets_no_offset():
    nothing = np.full((2, N_JOINTS, 3), np.nan)
    assert set(fit_offsets(nothing, nothing, np.ones((2, N_JOINTS), bool)).values()) == {0.0}


def test_fitting_without_truth_says_so(flat_frame, tmp_path):
    write_recording(tmp_path / "blind", [flat_frame])
    with pytest.raises(UnderstudyError, match=r"blind.*no truth\.json"):
        fit_offsets_on([open_recording(tmp_path / "blind")])


def test_depths_around_a_keypoint():
    depth = np.full((1, 2, 64, 64), EMPTY, np.float32)
    depth[0, 0, 10, 20:23] = 0.1, 0.2, 0.3  # columns 20 to 22 of row 10
    depth[0, 0, 12, 20] = 0.4
    at = (np.array([20, 10]) + 0.5) * CELL - HALF  # the middle of the first of them
    xy = np.full((1, N_JOINTS, 2), np.nan)
    xy[0, 0], xy[0, 1], xy[0, 2] = at, at + (5 * CELL, 0), (9.0, 9.0)
    z = grid_depths(depth, xy)
    np.testing.assert_allclose(z[0, 0], [0.1, 0.2, 0.3], rtol=1e-6)
    assert np.isnan(z[0, 1:]).all()


def test_input_of_what_is_missing_is_zero():
    depth = np.full((1, 2, 64, 64), EMPTY, np.float32)
    features, naive = mlp_input(depth, np.zeros((1, N_JOINTS, 3), np.float32), np.full((1, 1), 2.0, np.float32))
    assert features.shape == (1, baselines.N_FEATURES) and features.dtype == np.float32
    np.testing.assert_array_equal(features[0, :-2], 0)
    np.testing.assert_allclose(features[0, -2:], [2.0, 0.5])
    assert not naive.any()


def test_a_mirror_twice_is_none():
    keypoints = np.random.default_rng(0).normal(size=(2, N_JOINTS, 3))
    once = mirrored(keypoints)
    np.testing.assert_array_equal(mirrored(once), keypoints)
    assert once[0, JOINT["left_hip"], 0] == -keypoints[0, JOINT["right_hip"], 0]


class Walls:
    """Batches of people before walls: the joints lie 10 cm behind what is measured at their keypoints."""

    def __getitem__(self, number: int):
        torch = pytest.importorskip("torch")
        from understudy.synthetic.samples import Batch

        rng = np.random.default_rng(number)
        b = 64
        wall = rng.uniform(-0.3, 0.3, (b, 1))
        depth = np.broadcast_to(wall[:, :, None, None], (b, 2, 64, 64)).astype(np.float32)
        xy = rng.uniform(-1, 1, (b, N_JOINTS, 2)).astype(np.float32)
        keypoints = np.concatenate([xy, np.full((b, N_JOINTS, 1), 0.9, np.float32)], -1)
        joints = np.concatenate([xy, np.broadcast_to(wall[..., None] + 0.1, (b, N_JOINTS, 1))], -1).astype(np.float32)
        yes = torch.ones(b, N_JOINTS, dtype=torch.bool)
        data = (torch.from_numpy(np.ascontiguousarray(a)) for a in (depth, keypoints, np.full((b, 1), 3, "f4"), joints))
        *given, joints = data
        return Batch(*given, torch.zeros(b, 4), joints, yes, ~yes, yes[:, 0], torch.zeros(b, 2))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    pytest.importorskip("torch")
    from understudy.voxelposenet.mlp import train_mlp

    out = tmp_path_factory.mktemp("mlp") / "mlp.safetensors"
    return out, train_mlp(out, steps=200, hidden=32, batches=Walls())


def test_the_mlp_learns(trained):
    out, _ = trained
    batch = Walls()[1000]
    features, naive = mlp_input(*(t.numpy() for t in (batch.depth, batch.keypoints, batch.root_z)))
    said = MlpPredictor(out).forward(features, naive)
    truth = batch.joints.numpy()
    before, after = (np.linalg.norm(x - truth, axis=-1).mean() for x in (naive, said.joints))
    assert before == pytest.approx(0.1, abs=1e-3)
    assert after < 0.05
    assert said.confidence.mean() > 0.6 and said.confidence.max() <= 1 and (said.sigma > 0).all()


def test_numpy_equals_torch(trained):
    import torch

    out, net = trained
    rng = np.random.default_rng(3)
    features = rng.normal(size=(5, baselines.N_FEATURES)).astype(np.float32)
    naive = rng.normal(size=(5, N_JOINTS, 3)).astype(np.float32)
    said = MlpPredictor(out).forward(features, naive)
    with torch.inference_mode():
        joints, judged = (t.numpy() for t in net(torch.from_numpy(features), torch.from_numpy(naive)))
    np.testing.assert_allclose(said.joints, joints, atol=1e-4)
    np.testing.assert_allclose(said.sigma, np.exp(judged[:, 0]), rtol=1e-3)
    np.testing.assert_allclose(said.confidence, 1 / (1 + np.exp(-judged[:, 1])), atol=1e-4)


def test_the_same_steps_give_the_same_weights(trained, tmp_path):
    from safetensors.numpy import load_file

    from understudy.voxelposenet.mlp import train_mlp

    files = [tmp_path / f"{i}.safetensors" for i in range(2)]
    for file in files:
        train_mlp(file, steps=25, hidden=16, batches=Walls())
    first, second = map(load_file, files)
    assert all((second[name] == tensor).all() for name, tensor in first.items())
    with pytest.raises(UnderstudyError, match="either minutes or steps"):
        train_mlp(files[0], batches=Walls())


def test_lifting_by_the_mlp(trained, flat_frame):
    nobody = Keypoints2D(np.zeros((N_JOINTS, 2)), np.zeros(N_JOINTS))
    none, person = MlpLifter(trained[0]).lift(register(flat_frame), [nobody, standing()])
    assert none.failed and person.failed is None
    assert np.isfinite(person.keypoints).all() and abs(person.keypoints[:, 2].mean() - 2) < 0.6
    assert MlpLifter(trained[0]).lift(register(flat_frame), []) == []


def test_other_files_are_refused(tmp_path):
    pytest.importorskip("safetensors")
    from safetensors.numpy import save_file

    (tmp_path / "broken.safetensors").write_bytes(b"no")
    save_file({"a": np.zeros(1, np.float32)}, tmp_path / "other.safetensors")
    for name, message in (("broken", "not a readable"), ("other", "format is None"), ("absent", "absent")):
        with pytest.raises(ModelFileError, match=message):
            MlpPredictor(tmp_path / f"{name}.safetensors")
