"""From trained weights to joints: export, the light runtime against torch, the lifter on a recording, files refused."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from safetensors.torch import load_file, save_file  # noqa: E402

from understudy import recordings, runtime  # noqa: E402
from understudy.cli import main  # noqa: E402
from understudy.errors import ModelFileError, UnderstudyError  # noqa: E402
from understudy.floor import CAMERA_UP, Floor  # noqa: E402
from understudy.registration import register  # noqa: E402
from understudy.types import Keypoints2D  # noqa: E402
from understudy.voxel_lifting import VoxelLifter  # noqa: E402
from understudy.voxelposenet import publish as publishing  # noqa: E402
from understudy.voxelposenet.checkpoint import load_net, save_weights  # noqa: E402
from understudy.voxelposenet.export import INPUTS, OUTPUTS, export_onnx  # noqa: E402
from understudy.voxelposenet.net import NetConfig, VoxelPoseNet  # noqa: E402
from understudy.voxelposenet.predictor import Predictor, keypoint_input  # noqa: E402
from understudy.voxelposenet.publish import publish  # noqa: E402
from understudy.voxelposenet.training import PRESETS, Trainer  # noqa: E402
from understudy.voxels import CELLS, EMPTY, PersonView, cloud  # noqa: E402

TINY = NetConfig(channels=(8, 8, 8), channels_2d=8, lifted=2)


@pytest.fixture(scope="module")
def net() -> VoxelPoseNet:
    """Random weights, and statistics that a training could have left."""
    torch.manual_seed(3)
    net = VoxelPoseNet(TINY)
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d | torch.nn.BatchNorm3d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    return net.eval()


@pytest.fixture(scope="module")
def exported(net, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "tiny.onnx"
    export_onnx(net, path, half=False)
    return path


def inputs(b: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(b)
    depth = rng.uniform(-1, 1, (b, 2, CELLS, CELLS))
    depth[:, :, rng.random((CELLS, CELLS)) < 0.3] = EMPTY
    keypoints = np.concatenate([rng.uniform(-0.8, 0.8, (b, 18, 2)), rng.random((b, 18, 1))], -1)
    keypoints[:, 4] = 0
    floor = np.tile([0.0, -1.0, 0.0, 1.4], (b, 1)) * (np.arange(b) > 0)[:, None]  # of the first one, none
    arrays = {"depth": depth, "keypoints": keypoints, "root_z": rng.uniform(1, 5, (b, 1)), "floor": floor}
    return {k: v.astype(np.float32) for k, v in arrays.items()}


def test_runtime_agrees_with_torch(net, exported):
    network = runtime.load(exported, threads=1, outputs=OUTPUTS)
    for b in (1, 2, 5):
        given = inputs(b)
        with torch.inference_mode():
            expected = net(*(torch.tensor(given[k]) for k in INPUTS))
        for name, got, want in zip(OUTPUTS, network(**given), expected, strict=True):
            np.testing.assert_allclose(got, want.numpy(), atol=1e-4, err_msg=f"{name}, {b} people")


def test_half_the_size_is_nearly_the_same(net, exported, tmp_path):
    export_onnx(net, tmp_path / "half.onnx", half=True)
    assert (tmp_path / "half.onnx").stat().st_size < exported.stat().st_size
    given = inputs(3)
    full, half = (runtime.load(p, threads=1, outputs=OUTPUTS)(**given) for p in (exported, tmp_path / "half.onnx"))
    np.testing.assert_allclose(half[0], full[0], atol=2e-3)  # metres


def test_predictor_reads_the_networks_numbers(net, exported):
    given = inputs(2)
    views = [PersonView.towards(np.array([0.3, 0.1, z])) for z in (2.0, 4.0)]
    given["root_z"] = np.array([[v.root_z] for v in views], np.float32)
    floor = Floor(CAMERA_UP, -1.4)
    given["floor"] = np.stack([v.floor_plane(floor) for v in views])
    predictor = Predictor(exported, threads=1)
    said = predictor(views, given["depth"], given["keypoints"], floor)
    with torch.inference_mode():
        out = net(*(torch.tensor(given[k]) for k in INPUTS))
    for i, person in enumerate(said):
        np.testing.assert_allclose(person.sigma, out.head[i, :, 0].exp(), rtol=1e-3)
        np.testing.assert_allclose(person.confidence, out.head[i, :, 1].sigmoid(), atol=1e-4)
        np.testing.assert_allclose(person.seen, out.head[i, :, 2].sigmoid(), atol=1e-4)
    assert predictor([], np.empty((0, 2, 64, 64), np.float32), np.empty((0, 18, 3), np.float32)) == []
    without = predictor(views, given["depth"], given["keypoints"])
    assert all((a.joints != b.joints).any() for a, b in zip(said, without, strict=True))


@pytest.mark.parametrize("refinement", [0, 2])
def test_networks_without_a_floor_can_still_be_used(tmp_path, refinement):
    old = VoxelPoseNet(replace(TINY, floor=False, refinement=refinement)).eval()
    export_onnx(old, tmp_path / "old.onnx", half=False)
    given = inputs(1)
    view = PersonView.towards(np.array([0.0, 0.0, 2.5]))
    said = Predictor(tmp_path / "old.onnx", threads=1)(
        [view], given["depth"], given["keypoints"], Floor(CAMERA_UP, -1.0)
    )
    root_z = torch.full((1, 1), view.root_z)
    with torch.inference_mode():
        out = old(torch.tensor(given["depth"]), torch.tensor(given["keypoints"]), root_z, torch.zeros(1, 4))
    np.testing.assert_allclose(said[0].joints, out.joints[0], atol=1e-4)


# --- on a recording ---


@pytest.fixture(scope="module")
def seen():
    """The first frame of the bundled recording, and the true joints of its people as 2D keypoints."""
    recording = recordings.open("sample")
    frame = register(recording[0])
    assert recording.truth is not None
    people = []
    for person in recording.truth.frames[0]:
        score = np.where(person.in_view, np.where(person.occluded, 0.4, 0.9), 0.0)
        people.append(Keypoints2D.where(frame.camera.project(person.keypoints), score))
    return frame, people


def test_everybody_in_their_order(exported, seen):
    frame, people = seen
    nobody = Keypoints2D.where(np.zeros((18, 2)), np.zeros(18))
    lifter = VoxelLifter(weights=exported)
    lifted = lifter.lift(frame, [nobody, *people, nobody])
    assert [p.failed is not None for p in lifted] == [True, *(False for _ in people), True]
    assert [p.keypoints_2d for p in lifted] == [nobody, *people, nobody]
    for person in lifted[1:-1]:
        assert np.isfinite(person.keypoints).all() and (person.sigma_m > 0).all()
        assert ((person.confidence >= 0) & (person.confidence <= 1)).all()
        assert set(person.source) <= {"observed", "inferred"}
        assert all(s == "inferred" for s, k in zip(person.source, person.keypoints_2d.score, strict=True) if k == 0)
    backwards = lifter.lift(frame, people[::-1])
    for a, b in zip(lifted[1:-1], backwards[::-1], strict=True):
        np.testing.assert_allclose(a.keypoints, b.keypoints, atol=1e-5)
    assert [p.failed is None for p in lifter.lift(frame, [nobody])] == [False]
    assert lifter.lift(frame, []) == []


def test_joints_land_about_the_person(exported, seen):
    """Even an untrained network answers within the grid, which stands about the person."""
    frame, people = seen
    truth = recordings.open("sample").truth
    assert truth is not None
    for person, true in zip(VoxelLifter(weights=exported).lift(frame, people), truth.frames[0], strict=True):
        assert np.linalg.norm(person.keypoints.mean(0) - true.keypoints.mean(0)) < 0.8


def test_input_of_keypoints(seen):
    frame, people = seen
    view = PersonView.towards(np.array([0.1, 0.2, 3.0]))
    weak = Keypoints2D(people[0].uv, np.where(np.arange(18) == 4, 0.1, people[0].score))
    rows = keypoint_input(view, frame.camera, weak, 0.2)
    assert rows.dtype == np.float32 and (rows[4] == 0).all()
    used = weak.score >= 0.2
    np.testing.assert_allclose(rows[used, :2], view.columns(frame.camera, weak.uv)[used], rtol=1e-6)
    np.testing.assert_allclose(rows[used, 2], weak.score[used], rtol=1e-6)


def test_training_and_use_see_the_same_columns(seen):
    """What `depth_grid` says in the columns of visible joints is near the truth's depth there."""
    frame, people = seen
    truth = recordings.open("sample").truth
    assert truth is not None
    for true in truth.frames[0]:
        view = PersonView.towards(true.keypoints[[1, 8, 11]].mean(0))
        grid = view.depth_grid(cloud(frame.depth))
        visible = true.in_view & ~true.occluded
        places = view.from_cam(true.keypoints[visible])
        column = np.floor((places[:, :2] + 32 * 2.64 / 64) / (2.64 / 64)).astype(int).clip(0, 63)
        found = grid[0, column[:, 1], column[:, 0]]
        assert np.median(np.abs(found[found < EMPTY] - places[found < EMPTY, 2])) < 0.15
    assert people


# --- files ---


def test_weights_come_back(net, tmp_path):
    path = tmp_path / "w.safetensors"
    save_weights(path, net.state_dict(), net.config, {"note": "x"})
    again = load_net(path)
    assert again.config == net.config and not again.training
    assert all(torch.equal(v, net.state_dict()[k]) for k, v in again.state_dict().items())


def test_other_files_are_refused(net, tmp_path):
    path = tmp_path / "w.safetensors"
    good = {k: v.contiguous() for k, v in net.state_dict().items()}

    def refused(words: str, tensors=None, about=None) -> None:
        if tensors is not None:
            save_file(tensors, path, about)
        with pytest.raises(ModelFileError, match=words):
            load_net(path)

    about = {
        "format": "understudy-voxelposenet/1",
        "net": '{"channels": [8, 8, 8], "channels_2d": 8, "lifted": 2, "floor": true, "refinement": 3}',
    }
    refused("not a readable safetensors file")  # absent
    refused("format is None", good)
    refused("format is 'understudy.paper_net/1'", good, {"format": "understudy.paper_net/1", "variant": "paper"})
    refused(
        "do not fit",
        good,
        {**about, "net": '{"channels": [8, 8, 16], "channels_2d": 8, "lifted": 2, "floor": true, "refinement": 3}'},
    )
    refused("do not fit", good, {**about, "net": '{"wings": 2}'})
    refused("do not fit", good, {**about, "net": "["})
    refused("do not fit", good, {"format": about["format"]})
    refused("do not fit", {k: v for k, v in good.items() if k != "score.bias"}, about)
    save_file(good, path, about)
    assert isinstance(load_net(path), VoxelPoseNet)
    path.write_bytes(path.read_bytes()[:-9])
    refused("not a readable safetensors file")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Iterator[Path]:
    """A training run of one step."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("UNDERSTUDY_CACHE", str(tmp_path_factory.getbasetemp() / "bodies"))
        out = tmp_path_factory.mktemp("run")
        Trainer(replace(PRESETS["smoke"], steps=1, plots=False, validation_samples=1), out).run()
        yield out


def test_export_and_info_commands(run, tmp_path, capsys, seen, monkeypatch):
    out = tmp_path / "files"
    monkeypatch.setattr(publishing, "publish", partial(publish, samples=16))
    assert main(["weights", "export", str(run), "--out", str(out)]) == 0
    assert {p.name for p in out.iterdir()} == {"voxelposenet.safetensors", "voxelposenet.onnx", "MODEL_CARD.md"}
    card = (out / "MODEL_CARD.md").read_text()
    for words in ("voxelposenet.onnx", "4 of capsules", "| all | ", '"steps": 1', "kinect2, azure", "Command: `"):
        assert words in card
    frame, people = seen
    assert all(p.failed is None for p in VoxelLifter(weights=out / "voxelposenet.onnx").lift(frame, people))
    capsys.readouterr()
    assert main(["weights", "info", str(out / "voxelposenet.safetensors")]) == 0
    printed = capsys.readouterr().out
    assert "format      understudy-voxelposenet/1" in printed
    numbers = sum(t.numel() for t in load_file(out / "voxelposenet.safetensors").values())
    assert f"{numbers:,} numbers" in printed
    assert main(["weights", "info", str(out / "voxelposenet.onnx")]) == 0
    assert "depth, keypoints, root_z" in capsys.readouterr().out
    for wrong, words in (
        (["info", str(out / "MODEL_CARD.md")], "not a readable safetensors file"),
        (["info", str(out / "absent.onnx")], "no such file"),
        (["export", str(tmp_path), "--out", str(out)], "not a training run"),
        (["import", str(out), "x.txt"], "must end in .safetensors"),
        (["import", str(out), "x.safetensors", "--variant", "fast"], "--variant 'fast': must be one of 'paper'"),
        (["import", str(tmp_path / "absent"), "x.safetensors"], "no such weights"),
    ):
        assert main(["weights", *wrong]) == 2
        assert words in capsys.readouterr().err


def test_damaged_weights_are_not_published(run, tmp_path):
    for path in run.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    weights = tmp_path / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(ModelFileError, match="weights.safetensors"):
        publish(tmp_path, tmp_path / "files")
    assert issubclass(ModelFileError, UnderstudyError) and not (tmp_path / "files").exists()
