"""The paper's input from our batches, against that from the image itself; and the paper's network trained."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from safetensors import safe_open  # noqa: E402

from understudy.camera import Camera  # noqa: E402
from understudy.skeleton import JOINTS  # noqa: E402
from understudy.synthetic.samples import Batch  # noqa: E402
from understudy.types import Keypoints2D, RegisteredDepth  # noqa: E402
from understudy.voxelposenet import paper_data, records  # noqa: E402
from understudy.voxelposenet.paper_grid import (  # noqa: E402
    SIZE,
    PaperGrid,
    assemble_paper,
    depth_points,
    network_input,
    paper_root,
    pixel_rays,
    volume_peaks,
)
from understudy.voxelposenet.paper_net import load_paper_net, target_volumes  # noqa: E402
from understudy.voxelposenet.predictor import keypoint_input  # noqa: E402
from understudy.voxelposenet.publish import publish  # noqa: E402
from understudy.voxelposenet.training import PRESETS, Trainer  # noqa: E402
from understudy.voxels import PersonView, cloud  # noqa: E402

CAMERA = Camera(960, 540, np.array([[540.7, 0, 479.5], [0, 540.7, 269.5], [0, 0, 1.0]]))
_SIDE = {
    "shoulder": (0.17, -0.35), "elbow": (0.22, -0.05), "wrist": (0.24, 0.2), "hip": (0.11, 0.15), "knee": (0.11, 0.57),
    "ankle": (0.11, 0.97), "eye": (0.03, -0.62), "ear": (0.075, -0.6),
}  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def one_thread(tmp_path_factory):
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("UNDERSTUDY_CACHE", str(tmp_path_factory.getbasetemp() / "bodies"))
        yield
    torch.set_num_threads(before)


def scene() -> tuple[np.ndarray, RegisteredDepth]:
    """An adult who faces the camera at 3 m: joints (metres, inside the body), and what the camera measures."""
    joints = np.zeros((18, 3))
    for i, name in enumerate(JOINTS):
        side, _, part = name.rpartition("_")
        right, y = _SIDE.get(part, (0.0, -0.58 if part == "nose" else -0.35))
        joints[i] = (right if side == "left" else -right), y, 3.1 - 0.3 * (part == "wrist")
    u, v = np.meshgrid(np.arange(960), np.arange(540))
    x, y = (u - 479.5) / 540.7, (v - 269.5) / 540.7
    z = np.where((np.abs(x) < 0.09) & (np.abs(y) < 0.33), 3.0 + 2 * x**2, 3.9)
    return joints, RegisteredDepth(z.astype(np.float32), CAMERA)


def batch_of(joints: np.ndarray, depth: RegisteredDepth, seen: Keypoints2D) -> Batch:
    view = PersonView.towards(np.array([0.0, 0.0, 3.05]))  # along the axis: the view's frame is the camera's

    def one(a: np.ndarray) -> torch.Tensor:
        return torch.tensor(a, dtype=torch.float32)[None]

    flags = torch.zeros(1, 18, dtype=torch.bool)
    return Batch(
        one(view.depth_grid(cloud(depth))), one(keypoint_input(view, CAMERA, seen, 0.0)), one(np.array([view.root_z])),
        torch.zeros(1, 4),
        one(view.from_cam(joints)), ~flags, flags, flags[:, 0], torch.zeros(1, 2, dtype=torch.long),
    )  # fmt: skip


@pytest.mark.parametrize("hidden", [(), ("neck",), ("neck", "right_hip")])
def test_like_the_input_from_the_image(hidden):
    joints, depth = scene()
    score = np.where(np.isin(JOINTS, hidden), 0.3, 0.9)
    seen = Keypoints2D.where(CAMERA.project(joints), score)
    root = paper_root(seen, depth, CAMERA)
    assert root is not None
    expected = network_input(depth_points(depth, pixel_rays(CAMERA)), seen, CAMERA, root).transpose(3, 0, 1, 2)
    made = paper_data.paper_batch(batch_of(joints, depth, seen))
    grid = PaperGrid.around(root)
    assert made.rooted.all()
    np.testing.assert_allclose(made.origin[0], grid.origin, atol=0.02)
    np.testing.assert_allclose(made.cells[0], grid.index(joints), atol=0.5)
    np.testing.assert_allclose(
        made.input[0, 1:], expected[1:], atol=0.35
    )  # a keypoint near a border may fall to either
    assert np.abs(made.input[0, 1:].numpy() - expected[1:]).mean() < 0.01
    got, want = made.input[0, 0].numpy() > 0, expected[0] > 0
    # a column or a slice of cells next to it counts as met: the grids stand up to a centimetre apart
    grown = torch.nn.functional.max_pool3d(torch.tensor(want[None, None]).float(), 3, 1, 1)[0, 0].numpy() > 0
    assert (got & grown).sum() > 0.97 * got.sum() and 0.6 < got.sum() / want.sum() < 1.4


def test_who_has_no_root_is_left_out():
    joints, depth = scene()
    seen = Keypoints2D.where(CAMERA.project(joints), np.where(np.isin(JOINTS, ("nose", "left_knee")), 0.9, 0.2))
    made = paper_data.paper_batch(batch_of(joints, depth, seen))
    assert not made.rooted.any() and torch.isnan(made.cells).all() and torch.isfinite(made.input).all()
    np.testing.assert_allclose(made.origin[0] + 0.5 * SIZE * paper_data.cell_size(), [0, 0, 3.05], atol=1e-4)


def test_peaks_and_assembly_are_the_papers():
    joints, depth = scene()
    seen = Keypoints2D.where(CAMERA.project(joints), np.linspace(0.5, 1, 18))
    root = paper_root(seen, depth, CAMERA)
    assert root is not None
    batch = batch_of(joints, depth, seen)
    made = paper_data.paper_batch(batch)
    volumes = target_volumes(made.cells, (SIZE,) * 3) * torch.linspace(1, 0.5, 18)[:, None, None, None]
    metres, score = paper_data.peaks(volumes, made.origin)
    assert (metres[0] - torch.tensor(joints)).abs().max() <= paper_data.cell_size() / 2 + 1e-4
    grid = PaperGrid(made.origin[0].double().numpy(), paper_data.cell_size())
    xyz, score3d = volume_peaks(volumes[0].numpy(), grid)
    np.testing.assert_allclose(metres[0], xyz, atol=1e-4)
    expected = assemble_paper(seen, CAMERA, xyz, score3d)
    got = paper_data.to_metres(paper_data.assembled(metres, score, batch), batch.root_z)
    np.testing.assert_allclose(got[0], expected, atol=1e-3)


def test_view_and_metres_are_inverse():
    view = torch.rand(3, 18, 3) - 0.5
    root_z = torch.tensor([[1.0], [2.0], [4.0]])
    metres = paper_data.to_metres(view, root_z)
    torch.testing.assert_close(paper_data.to_view(metres, root_z), view, atol=1e-5, rtol=0)
    expected = PersonView(np.eye(3), 2.0).to_cam(view[1].double().numpy())
    np.testing.assert_allclose(metres[1], expected, atol=1e-6)


def test_the_papers_network_is_trained_by_the_same_trainer(tmp_path):
    """A coarse grid, two steps: interrupted by the first one's checkpoint, and gone on with."""
    data = PRESETS["smoke"].data
    config = replace(PRESETS["paper"], grid=16, data=data, steps=1, validation_samples=1, log_every=1, workers=0,
                     plots=False)  # fmt: skip
    Trainer(config, tmp_path / "run").run()
    trainer = Trainer(replace(config, steps=2), tmp_path / "run")
    assert trainer.step == 1
    trainer.run()
    log = records.read(tmp_path / "run" / "log.csv")
    assert [r["step"] for r in log] == ["1", "2"] and all(np.isfinite(float(r["loss"])) for r in log)
    assert float(records.read(tmp_path / "run" / "validation.csv")[1]["all"]) > 0
    assert load_paper_net(tmp_path / "run" / "weights.safetensors").variant == "paper-fast"
    made = publish(tmp_path / "run", tmp_path / "out")
    assert [p.name for p in made] == ["voxelposenet-paper-fast.safetensors", "MODEL_CARD.md"]
    with safe_open(made[0], "np") as f:
        assert f.metadata()["step"] == "2"
    card = made[1].read_text()
    assert "paper_grid" in card and "no calibrated uncertainty" in card
    assert "68 %" not in card and "PersonView" not in card
