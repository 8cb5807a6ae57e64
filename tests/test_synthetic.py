"""Laws of the simulator: depths, samples, sensors and detections, and recordings with truth."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from understudy import recordings, voxels  # noqa: E402
from understudy.camera import Camera  # noqa: E402
from understudy.cli import synth  # noqa: E402
from understudy.errors import MissingExtraError, RecordingError, UnderstudyError  # noqa: E402
from understudy.registration import register  # noqa: E402
from understudy.skeleton import FLIP, JOINT, JOINTS, rows  # noqa: E402
from understudy.synthetic import actors, recording, render, room, samples, surfels, timing, view  # noqa: E402
from understudy.synthetic.bodies import capsule_bank  # noqa: E402
from understudy.synthetic.detections import DetectorConfig, detect  # noqa: E402
from understudy.synthetic.draw import Draw  # noqa: E402
from understudy.synthetic.recording import RecordingConfig, Studio, write_synthetic  # noqa: E402
from understudy.synthetic.samples import LEAST_SEEN, SampleConfig, Samples, unhiding  # noqa: E402
from understudy.synthetic.scene import Boxes, SceneConfig, place_cameras  # noqa: E402
from understudy.synthetic.sensors import SENSORS, Rig  # noqa: E402

ALONE = SceneConfig(occluder=0.0, furniture=0, neighbours=0.0)
OPEN = SceneConfig(distance_m=(1.8, 3.0), occluder=0.0, aim_sigma_m=0.1)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def bank():
    return capsule_bank(5, seed=11, points=5000)


def sphere(n: int, center: tuple[float, float, float], radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Evenly spaced points and normals."""
    k = torch.arange(n) + 0.5
    z, phi = 1 - 2 * k / n, k * 2.399963
    normal = torch.stack([(1 - z * z).sqrt() * phi.cos(), (1 - z * z).sqrt() * phi.sin(), z], 1)
    return normal * radius + torch.tensor(center), normal


def ray_sphere(rays: torch.Tensor, center: tuple[float, float, float], radius: float) -> torch.Tensor:
    """Depth (z) of the nearer hit; NaN where there is none. rays: (..., 3) with z = 1."""
    c = torch.tensor(center)
    a, b = (rays * rays).sum(-1), (rays * c).sum(-1)
    return (b - (b * b - a * ((c * c).sum() - radius**2)).sqrt()) / a


# --- depths ---


def test_splat_of_a_sphere_is_its_front():
    center, radius, size = (0.1, -0.05, 3.0), 0.5, 144
    points, normals = sphere(20000, center, radius)
    front = (points * normals).sum(1) < 0
    scale = torch.tensor([145.0])
    z, label = render.splat(points[front][None], (points[front, 0] > center[0])[None], scale, size)
    rays = render.pixel_rays(scale, size)
    inner = ray_sphere(rays, center, 0.7 * radius).isfinite()  # where the surface is not steep
    exact = ray_sphere(rays, center, radius)
    assert (z - exact)[inner].abs().max() < 0.03
    assert (z == render.FAR)[ray_sphere(rays, center, 1.1 * radius).isnan()].all()
    side = (rays * exact[..., None])[..., 0] - center[0]
    clear = inner & (side.abs() > 0.04)
    assert (label == (side > 0))[clear].all()


def test_splat_leaves_out_nan_and_what_is_behind():
    points = torch.tensor([[[0.0, 0.0, torch.nan], [0.0, 0.0, -1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 5.0]]])
    z, label = render.splat(points, torch.tensor([[True, True, False, True]]), torch.tensor([50.0]), 8)
    assert (z < render.FAR).sum() == 4
    assert z.min() == 2.0 and not label.any()


def random_boxes(generator: torch.Generator, b: int, k: int) -> Boxes:
    center = torch.rand(b, k, 3, generator=generator) * torch.tensor([3.0, 3.0, 2.0]) - torch.tensor([1.5, 0.0, 0.0])
    half = 0.1 + 0.4 * torch.rand(b, k, 3, generator=generator)
    return Boxes(center, half, 6.3 * torch.rand(b, k, generator=generator))


def test_cast_hits_the_first_surface_of_the_boxes():
    generator = torch.Generator().manual_seed(1)
    boxes = random_boxes(generator, 3, 4)
    origin = torch.tensor([[0.0, -2.0, 1.0], [1.0, -1.5, 0.5], [-1.0, -3.0, 2.0]])
    rays = torch.randn(3, 500, 3, generator=generator) * 0.4 + torch.tensor([0.0, 1.0, 0.0])
    z, which = render.cast_which(boxes, origin, rays)
    assert torch.equal(z, render.cast(boxes, origin, rays))
    hit = z < render.FAR
    assert torch.equal(hit, which >= 0) and hit.sum() > 100
    local = boxes.local(origin[:, None] + rays * z[..., None]).abs() / boxes.half[:, :, None]
    on = local.gather(1, which.clamp_min(0)[:, None, :, None].expand(-1, 1, -1, 3))[:, 0]
    assert (on.amax(-1)[hit] - 1).abs().max() < 1e-3
    for t in torch.linspace(0.06, 6, 200):  # nothing is passed through
        early = t < z - 1e-3
        inside = (boxes.local(origin[:, None] + rays * t).abs() < boxes.half[:, :, None] - 1e-4).all(-1).any(1)
        assert not (inside & early).any()


def test_cast_from_inside_a_box_does_not_hit_it():
    boxes = Boxes(torch.zeros(1, 1, 3), torch.ones(1, 1, 3), torch.zeros(1, 1))
    assert render.cast(boxes, torch.zeros(1, 3), torch.tensor([[[0.3, 1.0, 0.2]]])) == render.FAR


@pytest.mark.parametrize("distance", [0.8, 2.0, 5.0])
def test_surfels_make_a_closed_exact_surface(distance: float):
    camera = Camera(200, 160, np.array([[400.0, 0, 99.5], [0, 400.0, 79.5], [0, 0, 1]]))
    center, radius = (0.0, 0.0, distance), 0.25
    points, normals = sphere(3000, center, radius)
    near = surfels.neighbours(points, normals)
    z, mean = surfels.draw(surfels.Surfels(points, normals, surfels.radii(points, near), points), camera)
    v, u = torch.meshgrid(torch.arange(160.0), torch.arange(200.0), indexing="ij")
    rays = torch.stack([(u - 99.5) / 400, (v - 79.5) / 400, torch.ones_like(u)], -1)
    inner = ray_sphere(rays, center, 0.9 * radius).isfinite()
    exact = ray_sphere(rays, center, radius)
    assert (z < render.FAR)[inner].all()
    assert (z - exact)[inner].abs().max() < 0.006 and (z - exact)[inner].abs().mean() < 0.001
    assert (z == render.FAR)[ray_sphere(rays, center, 1.1 * radius).isnan()].all()
    hit = rays * exact[..., None]
    assert (mean[..., :3] - hit)[inner].norm(dim=-1).max() < 0.02  # values come from where the ray meets the surface
    normal = torch.nn.functional.normalize(mean[..., 3:], dim=-1)
    assert (normal * (hit - torch.tensor(center)) / radius).sum(-1)[inner].min() > 0.98


def test_surfels_of_a_tilted_plane_and_of_nothing():
    camera = Camera(80, 60, np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]]))
    x, y = torch.meshgrid(torch.arange(-1.5, 1.5, 0.02), torch.arange(-1.5, 1.5, 0.02), indexing="ij")
    points = torch.stack([x, y, 2 + 0.5 * x], -1).reshape(-1, 3)
    normal = torch.nn.functional.normalize(torch.tensor([0.5, 0.0, -1.0]), dim=0).expand(len(points), 3)
    flat = surfels.Surfels(points, normal, torch.full((len(points),), 0.03), points[:, :1])
    z, _ = surfels.draw(flat, camera)
    u = (torch.arange(80.0) - 40) / 100
    assert (z - 2 / (1 - 0.5 * u)).abs().max() < 1e-4
    away = replace(flat, normals=-flat.normals)
    assert (surfels.draw(away, camera)[0] == render.FAR).all()
    assert (surfels.draw(replace(flat, points=flat.points * torch.nan), camera)[0] == render.FAR).all()


# --- network input ---


def test_a_batch_is_a_function_of_seed_and_number(bank):
    config = SampleConfig()
    first = Samples(bank, config, 3).batch(2, 4)
    other = Samples(bank, config, 3)
    other.batch(0, 4)
    assert all(torch.equal(a, b) for a, b in zip(first, other.batch(2, 4), strict=True))
    assert all(torch.equal(a, b) for a, b in zip(first, next(other.stream(4, start=2)), strict=True))
    for different in (other.batch(3, 4), Samples(bank, config, 4).batch(2, 4)):
        assert not torch.equal(first.depth, different.depth) and not torch.equal(first.joints, different.joints)


def test_nobody_is_in_a_batch_twice(bank):
    joints = Samples(bank, seed=8).batch(0, 64).joints.reshape(64, -1)
    assert len(joints.unique(dim=0)) == 64


def test_people_stand_where_the_depth_camera_measures(bank):
    config = SampleConfig(sensors=("realsense",), scene=SceneConfig(occluder=0, neighbours=0))
    batch = Samples(bank, config, seed=8).batch(0, 64)
    assert (batch.in_view & ~batch.occluded).sum(1)[:-8].min() >= LEAST_SEEN
    on_person = (batch.depth[:, 0].abs() < 0.5).flatten(1).sum(1)
    assert (on_person > 20).all()


def test_furniture_that_hides_everything_goes():
    config, rig = SceneConfig(distance_m=(3.0, 3.1)), Rig(Draw(1), ("kinect2",), 4)
    joints = torch.tensor([0.0, 0.0, 1.0]) + 0.3 * torch.rand(4, 18, 3, generator=torch.Generator().manual_seed(1))
    cameras = place_cameras(Draw(2), replace(config, aim_sigma_m=0.0), joints)
    middle = (cameras.center + joints.mean(1)) / 2
    center = torch.stack([torch.tensor([0.0, 0.0, -0.5]).expand(4, 3), middle, joints.mean(1) + 2.0], 1)
    half = torch.tensor([[9.0, 9.0, 0.5], [1.0, 0.1, 1.5], [0.1, 0.1, 0.1]]).expand(4, 3, 3)
    boxes = Boxes(center, half, torch.zeros(4, 3))
    left = unhiding(boxes, cameras, rig, joints)
    assert (left.center[:, 1, 2] < -50).all()
    assert torch.equal(left.center[:, [0, 2]], center[:, [0, 2]])


def test_a_root_without_depth_is_judged_by_size():
    joints = torch.tensor([0.0, 0.0, 4.0]).expand(4000, 18, 3)
    yes = torch.ones(4000, 18, dtype=torch.bool)
    spread = [float(view.draw_root(Draw(3), joints, yes, measured)[1].std()) for measured in (yes, ~yes)]
    assert spread[0] < 0.12
    assert spread[1] == pytest.approx(0.48, rel=0.1)


def test_batches_are_what_the_network_takes(bank):
    batch = Samples(bank, SampleConfig(), 1).batch(0, 24)
    assert batch.depth.shape == (24, 2, 64, 64) and batch.keypoints.shape == (24, 18, 3)
    assert all(t.isfinite().all() for t in batch)
    near, far = batch.depth.unbind(1)
    empty = near == voxels.EMPTY
    assert (near[~empty].abs() <= voxels.LIMIT).all() and (far[far != voxels.EMPTY].abs() < voxels.HALF).all()
    assert ((batch.in_view & ~batch.occluded).sum(1) >= samples.LEAST_SEEN).all()
    assert (batch.keypoints[batch.keypoints[..., 2] == 0] == 0).all()
    assert (batch.tag[:, 0] < 4).all()


def test_visible_joints_lie_behind_the_measured_surface(bank):
    config = SampleConfig(scene=ALONE, sensors=("kinect2",))
    behind = []
    for number in range(3):
        batch = Samples(bank, config, 5).batch(number, 16)
        cell = ((batch.joints[..., :2] + voxels.HALF) / voxels.CELL).floor().long()
        inside = ((cell >= 0) & (cell < 64)).all(-1)
        index = torch.where(inside, cell[..., 1] * 64 + cell[..., 0], 0)
        near = batch.depth[:, 0].flatten(1).gather(1, index)
        good = inside & batch.in_view & ~batch.occluded & (near < voxels.LIMIT) & (batch.joints[..., 2].abs() < 1.3)
        behind.append((batch.joints[..., 2] - near)[good])
    depth = torch.cat(behind)
    assert len(depth) > 250
    assert ((depth > -0.06) & (depth < 0.26)).float().mean() > 0.95
    assert 0.02 < depth.median() < 0.15


def test_occlusion_of_a_made_scene():
    size, scale = 144, torch.tensor([145.0])
    person = torch.full((1, size, size), 3.0)
    exact = person.clone()
    exact[:, :, : size // 2] = 2.0  # a board before the left half
    joints = torch.zeros(1, 18, 3)
    joints[..., 2] = 3.05
    joints[0, :9, 0], joints[0, 9:, 0] = -0.4, 0.4
    joints[0, JOINT["left_knee"], 2] = 3.4  # far behind the own surface
    joints[0, JOINT["left_ankle"], 0] = 9.0  # beside the raster
    joints[0, JOINT["right_wrist"], 2] = 1.9  # before the board
    occluded, before = samples._occluded(joints, exact, person, scale)
    expected = np.arange(18) < 9
    expected[rows("left_knee")] = True
    expected[rows("right_wrist")] = False
    assert occluded[0].tolist() == expected.tolist()
    assert before.item()
    assert not samples._occluded(joints, person, person, scale)[1].item()


def test_depth_grid_and_rotation_are_those_of_the_person_view():
    rng = np.random.default_rng(0)
    for point in ([0.3, -0.4, 2.5], [-1.0, 0.5, 4.0]):
        person = voxels.PersonView.towards(np.array(point))
        assert np.allclose(view.rotation_to(torch.tensor([point]))[0].numpy(), person.R_view_cam, atol=1e-6)
        cloud = (rng.normal(0, 0.8, (4000, 3)) + point).astype(np.float32)
        ok = torch.from_numpy(rng.random(4000) < 0.8)
        in_view = (cloud @ person.R_view_cam.T.astype(np.float32)).astype(np.float32)
        root_z = torch.tensor([person.root_z], dtype=torch.float32)
        ours = view.depth_grid(torch.from_numpy(in_view)[None], ok[None], root_z)[0].numpy()
        theirs = person.depth_grid(cloud[ok.numpy()])
        assert (np.abs(ours - theirs) > 1e-4).mean() < 2e-3  # points on the border of a cell may fall either way
        columns = view.columns(torch.from_numpy(in_view)[None], root_z)[0].numpy()
        front = in_view[:, 2] > 0.2
        assert np.allclose(columns[front], person.from_cam(cloud[front]), atol=1e-4)


def test_floors_are_measured_nearly_where_they_are():
    """World z is the height above the floor, of most within centimetres; some see none."""
    draw, b = Draw(3), 4000
    center = torch.stack([torch.zeros(b), -draw.uniform(1, 6, b), draw.uniform(0.4, 2.4, b)], 1)
    R = view.rotation_to(draw.normal(b, 3))
    plane = view.draw_floor(draw, R, center)
    none = (plane == 0).all(1)
    assert none.float().mean() == pytest.approx(0.3, abs=0.03)
    torch.testing.assert_close(plane[~none, :3].norm(dim=1), torch.ones(int((~none).sum())))
    points = draw.normal(b, 8, 3) * torch.tensor([0.5, 0.5, 0.5])  # about the person
    in_view = (points - center[:, None]) @ R.transpose(1, 2)
    off = ((in_view * plane[:, None, :3]).sum(-1) + plane[:, 3:] - points[..., 2])[~none].abs()
    assert off.median() < 0.03 and (off < 0.1).float().mean() > 0.85 and off.max() > 0.3
    twice = [view.draw_floor(Draw(7), R, center) for _ in range(2)]
    assert torch.equal(*twice)


def test_speed_shares_out_the_whole_time(bank):
    speed = timing.measure(Samples(bank, SampleConfig(), 0), size=2, batches=2)
    assert sum(speed.ms.values()) == pytest.approx(1000 / speed.per_s)
    assert min(speed.ms.values()) >= 0 and all(speed.ms[part] > 0 for part in timing.PARTS)
    assert "samples/s" in speed.table()


# --- sensors ---


@pytest.mark.parametrize("name", SENSORS)
def test_sensor_noise_and_holes_are_as_configured(name: str):
    draw = Draw(7)
    rig = Rig(draw, (name,), 24)
    z = torch.full((24, 96, 120), 2.0)
    dark = torch.zeros_like(z, dtype=torch.bool)
    out = rig.degrade(draw, z, dark)
    valid = out > 0
    noise = torch.where(valid, (out - z) / rig.sigma_at(z), 0.0)
    spread = (noise.square().sum((1, 2)) / valid.sum((1, 2))).sqrt()
    low, high = (0.97, 1.03) if SENSORS[name].smooth == 0 else (0.75, 1.05)
    assert ((spread > low) & (spread < high)).all()
    assert noise.sum() / valid.sum() == pytest.approx(0, abs=0.05)
    kept = valid.float().mean((1, 2)) / rig.keep
    assert kept.max() < 1.02 and kept.median() > 0.9
    darker = (rig.degrade(draw, z, ~dark) > 0).float().mean((1, 2)) / rig.keep
    assert 1 - darker.mean() == pytest.approx(SENSORS[name].dark_hole, abs=0.06)


def test_sensor_range_edges_and_flying_pixels():
    draw = Draw(3)
    rig = Rig(draw, ("kinect2",), 16)
    far = torch.linspace(0.1, 12, 128).expand(16, 96, 128).contiguous()
    none = torch.zeros(far.shape, dtype=torch.bool)
    out = rig.degrade(draw, far, none)
    assert (out <= rig.max_z[:, None, None]).all() and (out[out > 0] >= 0.25).all()
    assert (out[:, :, -1] == 0).all()
    step = torch.full((16, 96, 128), 3.0)
    step[:, :, :64] = 2.0
    out = rig.degrade(draw, step, none)
    between = (out > 2.1) & (out < 2.9)
    assert not between[:, :, :62].any() and not between[:, :, 66:].any()
    flying = between[:, :, 63:65].float().mean()
    assert 0.02 < flying < 0.3
    lost = (out[:, :, 63:65] == 0).float().mean() - (out[:, :, 30:50] == 0).float().mean()
    assert lost == pytest.approx(0.5 * SENSORS["kinect2"].edge_hole, abs=0.06)


def test_holes_come_in_larger_patches_where_pixels_are_finer():
    share = []
    for finer in (1, 4):
        draw = Draw(3)
        rig = Rig(draw, ("azure",), 8)
        rig.keep = torch.ones(8)
        z = torch.full((8, 96, 96), 2.0)
        hole = rig.degrade(draw, z, torch.ones_like(z, dtype=torch.bool), finer) == 0
        share.append((hole[:, :, 1:] != hole[:, :, :-1]).float().mean() / hole.float().mean())
    assert share[1] < 0.5 * share[0]


# --- detections ---

CLEAN = DetectorConfig(jitter_m=0.0, hidden_m=0.0, pixel=1e-6, miss=0, gross=0, swap_person=0, swap_limbs=0, steal=0)


def detections(
    config: DetectorConfig, b: int = 6000, *, behind: bool = False, other: float = np.nan, hidden: bool = False
):
    """Detections of people whose sides lie 0.5 m apart, and their true places."""
    side = torch.tensor([-1.0 if "right" in n else 1.0 if "left" in n else 0.0 for n in JOINTS])
    height = torch.linspace(-0.8, 0.8, 18)
    height = (height + height[torch.as_tensor(FLIP)]) / 2
    height[JOINT["neck"]] = height[JOINT["right_shoulder"]]
    xy = torch.stack([0.25 * side, height], 1).expand(b, 18, 2)
    true, false = torch.ones(b, 18, dtype=torch.bool), torch.zeros(b, 18, dtype=torch.bool)
    turned = torch.full((b,), behind)
    return detect(Draw(2), config, xy, torch.full((b,), 3.0), true if hidden else false, true, turned, xy + other), xy


def test_a_perfect_detector_gives_the_truth():
    found, xy = detections(CLEAN)
    assert (found[..., 2] > 0).float().mean() > 0.99
    assert (found[..., :2] - xy)[found[..., 2] > 0].abs().max() < 1e-3


def test_jitter_is_as_configured():
    elbows = rows("right_elbow", "left_elbow")
    spread = []
    for jitter in (0.014, 0.028):
        found, xy = detections(replace(CLEAN, jitter_m=jitter))
        spread.append((found[:, elbows, :2] - xy[:, elbows])[found[:, elbows, 2] > 0].abs().median())
    assert spread[0] == pytest.approx(0.6745 * 0.014, rel=0.2)
    assert spread[1] / spread[0] == pytest.approx(2, rel=0.02)
    found, xy = detections(replace(CLEAN, jitter_m=0.014, hidden_m=0.06, top_down=1.0), hidden=True)
    good = found[:, elbows, 2] > 0
    assert (found[:, elbows, :2] - xy[:, elbows])[good].abs().median() > 3 * spread[0]


def test_misses_are_as_configured():
    others = [j for j in range(18) if j != JOINT["neck"]]  # the neck may come from the shoulders
    found, _ = detections(replace(CLEAN, miss=0.05, top_down=0.0))
    base, _ = detections(replace(CLEAN, top_down=0.0))
    missed = (found[:, others, 2] == 0).float().mean() - (base[:, others, 2] == 0).float().mean()
    assert missed == pytest.approx(0.05, abs=0.004)
    for top_down, share in ((0.0, 0.6), (1.0, 0.06)):
        found, _ = detections(replace(CLEAN, top_down=top_down), hidden=True)
        assert (found[:, others, 2] == 0).float().mean() == pytest.approx(share, abs=0.02)


def test_swaps_and_thefts_are_as_configured():
    def swapped(found: torch.Tensor, joint: str) -> float:
        seen = found[:, JOINT[joint], 2] > 0
        return float((found[seen, JOINT[joint], 0] > 0).float().mean())

    found, _ = detections(replace(CLEAN, swap_person=0.05))
    assert swapped(found, "right_hip") == pytest.approx(0.05, abs=0.01)
    assert swapped(found, "right_hip") == pytest.approx(swapped(found, "right_eye"), abs=0.003)
    found, _ = detections(replace(CLEAN, swap_person=0.05), behind=True)
    assert swapped(found, "right_hip") == pytest.approx(0.185, abs=0.02)  # 5 % or 15 %, and not both
    found, _ = detections(replace(CLEAN, swap_limbs=0.05))
    assert swapped(found, "right_knee") == pytest.approx(0.05, abs=0.01)
    assert swapped(found, "right_shoulder") == 0.0
    found, xy = detections(replace(CLEAN, steal=0.05), other=0.4)
    wrist = JOINT["left_wrist"]
    taken = (found[:, wrist, :2] - xy[:, wrist] - 0.4).abs().amax(-1) < 1e-3
    assert taken.float().mean() == pytest.approx(0.05, abs=0.01)
    assert not ((found[:, 0, :2] - xy[:, 0]).abs().amax(-1) > 1e-3)[found[:, 0, 2] > 0].any()


# --- recordings ---


@pytest.fixture(scope="module")
def written(bank, tmp_path_factory):
    out = tmp_path_factory.mktemp("synthetic") / "kinect"
    return write_synthetic(out, 5, 4, RecordingConfig(people=1, scene=OPEN), bank=bank)


def test_a_recording_shows_people_where_truth_says(written):
    recording = recordings.open(written)
    assert len(recording) == 5
    front = []
    for frame in recording.frames():
        registered = register(frame)
        cloud = voxels.cloud(registered.depth)
        for person in recording.truth.frames[frame.index]:
            joints = person.keypoints
            uv = registered.camera.project(joints)
            assert np.array_equal(person.in_view, registered.camera.contains(uv))
            assert not (person.occluded & ~person.in_view).any()
            view_ = voxels.PersonView.towards(joints[rows("neck", "right_hip", "left_hip")].mean(0))
            near = view_.depth_grid(cloud)[0]
            place = view_.from_cam(joints)
            cell = np.floor((place[:, :2] + voxels.HALF) / voxels.CELL).astype(int)
            good = person.in_view & ~person.occluded & (np.abs(place) < voxels.HALF - 0.05).all(1)
            surface = near[cell[good, 1], cell[good, 0]]
            front.append((place[good, 2] - surface)[surface < voxels.LIMIT])
    depth = np.concatenate(front)
    assert len(depth) > 30
    assert ((depth > -0.05) & (depth < 0.25)).mean() > 0.95


def test_a_recordings_detections_are_of_the_people(written):
    recording = recordings.open(written)
    color = recording.camera.color
    errors = []
    for index, people in recording.truth.frames.items():
        assert len(people) == 1 and len(recording.keypoints2d[index]) <= 1
        for found in recording.keypoints2d[index]:
            seen = found.found & people[0].in_view & ~people[0].occluded
            errors.append(np.linalg.norm(found.uv - color.project(people[0].keypoints), axis=1)[seen])
    assert np.median(np.concatenate(errors)) < 12


def test_palms_are_unit_normals(written):
    for people in recordings.open(written).truth.frames.values():
        for person in people:
            for side in ("left", "right"):
                assert np.linalg.norm(person.palms[side]) == pytest.approx(1)


def test_the_same_seed_writes_the_same_files(bank, written, tmp_path):
    config = RecordingConfig(people=1, scene=OPEN)
    again = Studio(5, 4, config, bank).frame(3)  # alone, without the frames before it
    first = next(f for f in recordings.open(written).frames() if f.index == 3)
    assert np.abs(again.frame.depth - first.depth).max() < 0.00051
    truth = recordings.open(written).truth.frames[3]
    assert np.array_equal(again.truth[0].keypoints, truth[0].keypoints)
    other = Studio(5, 5, config, bank).frame(3)
    assert not np.array_equal(other.frame.depth, again.frame.depth)


def test_a_box_in_front_hides_exactly_what_is_behind_it(bank):
    studio = Studio(1, 6, RecordingConfig(people=1, scene=replace(OPEN, furniture=0)), bank)
    made = studio._room(studio._draw(9), 1)
    moments = made.moments(0)
    R, center = made.cameras.R_cam_world[0], made.cameras.center[0]
    joints = moments[0].joints
    nothing = Boxes(torch.tensor([[[0.0, 0.0, -50.0]]]), torch.ones(1, 1, 3), torch.zeros(1, 1))
    middle = center + 0.5 * (joints[[8, 11]].mean(0) - center)
    board = Boxes(middle[None, None], torch.tensor([[[0.12, 0.02, 0.12]]]), torch.zeros(1, 1))
    flags = []
    for boxes in (nothing, board):
        here = replace(made, boxes=boxes)
        seen = room.look(here, moments, studio.raw_camera.color, R, center)
        truth = recording._truth(
            0, made.cameras.to_cam(joints[None])[0], moments[0], here, seen, studio.raw_camera.color
        )
        flags.append(truth.occluded)
    hit = render.cast(board, center[None], (joints - center)[None])[0] < 0.99
    behind = hit.numpy() & truth.in_view
    assert 2 <= behind.sum() < 16
    assert flags[1][behind].all()
    assert np.array_equal(flags[0][~behind], flags[1][~behind])


@pytest.mark.parametrize("sensor", recording.IMAGES)
def test_sensors_have_their_own_images(bank, sensor: str):
    config = RecordingConfig(sensor=sensor, people=1)
    camera = Studio(1, 0, config, bank).camera
    (width, height, f), (d_width, d_height, d_f) = recording.IMAGES[sensor]
    assert (camera.color.width, camera.color.height) == (width, height)
    assert (camera.depth.width, camera.depth.height) == (d_width, d_height)
    assert camera.color.fx == pytest.approx(f, rel=0.02) and camera.depth.fx == pytest.approx(d_f, rel=0.02)
    pitch = np.arcsin(camera.T_color_depth[1, 2])
    assert pitch == pytest.approx(SENSORS[sensor].depth_pitch, abs=1e-6)  # down is +y
    assert 0.005 < abs(camera.T_color_depth[0, 3]) < 0.07


def test_registered_sequences(bank, tmp_path):
    config = RecordingConfig(
        sensor="realsense", people=2, sequence=True, fps=5, activity="walking", registered=True, scene=OPEN
    )
    read = recordings.open(write_synthetic(tmp_path / "walk", 3, 1, config, bank=bank))
    assert read.camera.registered
    frames = list(read.frames())
    assert [f.timestamp_s for f in frames] == pytest.approx([0, 0.2, 0.4])
    assert all((f.depth > 0).mean() > 0.1 for f in frames)
    tracks = [np.array([p.keypoints for p in read.truth.frames[i] if p.id == 0]) for i in range(3)]
    steps = [np.linalg.norm(b[0] - a[0], axis=1) for a, b in pairwise(tracks)]
    assert all(s.max() < 1.0 and s.max() > 0.01 for s in steps)


def test_the_standing_foot_does_not_slide(bank):
    joints = torch.zeros(20, 18, 3)
    swing = torch.linspace(0, 6, 20)
    joints[:, 10, 1], joints[:, 13, 1] = 0.3 * swing.sin(), -0.3 * swing.sin()
    joints[:, 10, 2] = 0.1 * (swing.cos() < 0)  # lifted while it swings forward, towards -y
    joints[:, 13, 2] = 0.1 * (swing.cos() >= 0)
    turn, place = actors.walk(joints, torch.zeros(1), torch.zeros(1), 10.0)
    world = joints @ turn.mT + place[:, None]
    low = joints[:, [10, 13], 2].argmin(1)
    for k in range(19):
        if low[k] == low[k + 1]:
            foot = [10, 13][int(low[k])]
            assert (world[k + 1, foot, :2] - world[k, foot, :2]).norm() < 1e-5
    assert place[-1, 1] < -1.0  # it went forward


def test_nothing_is_overwritten_unasked_and_interrupted_writing_begins_anew(bank, tmp_path):
    config = RecordingConfig(people=1, scene=OPEN)
    out = write_synthetic(tmp_path / "a", 1, 2, config, bank=bank)
    first = (out / "truth.json").read_text()
    with pytest.raises(RecordingError, match="not empty"):
        write_synthetic(out, 1, 2, config, bank=bank)
    (out / "recording.json").unlink()  # it is written last
    write_synthetic(out, 1, 2, config, bank=bank)
    assert (out / "truth.json").read_text() == first
    settings = json.loads((out / "synthetic.json").read_text())
    assert settings["seed"] == 2 and settings["sensor"] == "kinect2"


@pytest.mark.parametrize(
    "wrong",
    [{"sensor": "kinect"}, {"people": 0}, {"people": 9}, {"body_count": 0}, {"fps": 0.0}, {"fps": float("nan")}],
)
def test_wrong_settings(wrong):
    with pytest.raises(UnderstudyError, match=next(iter(wrong))):
        RecordingConfig(**wrong)


def test_wrong_movements(bank, tmp_path):
    for wrong in ({"activity": "flying"}, {"bvh": str(tmp_path / "none")}, {"bvh": str(tmp_path)}):
        with pytest.raises(UnderstudyError):
            Studio(1, 0, RecordingConfig(**wrong), bank)
    with pytest.raises(UnderstudyError, match="not both"):
        actors.Motions("walking", tmp_path)
    with pytest.raises(UnderstudyError, match="frames"):
        Studio(0, 0, RecordingConfig(), bank)
    with pytest.raises(UnderstudyError, match="kind of bodies"):
        Studio(1, 0, RecordingConfig(bodies="dolls"))


# --- command line ---


def run(*arguments: str) -> None:
    parser = argparse.ArgumentParser()
    synth.add(parser.add_subparsers())
    parsed = parser.parse_args(["synth", *arguments])
    parsed.run(parsed)


def test_command_line(bank, tmp_path, monkeypatch, capsys):
    from understudy.synthetic import preview

    for module in (preview, recording):
        monkeypatch.setattr(module, "load_bank", lambda kind, n, seed: bank)
    run("--preview", str(tmp_path / "sheet.png"))
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UnderstudyError, match="png"):
        run("--preview", str(tmp_path / "sheet.jpg"))
    run(str(tmp_path / "one"), "--frames", "1", "--people", "1", "--sensor", "azure", "--activity", "sitting")
    assert len(recordings.open(tmp_path / "one")) == 1
    for wrong in ((), (str(tmp_path / "x"), "--speed")):
        with pytest.raises(UnderstudyError, match="give one of"):
            run(*wrong)


def test_missing_parts_are_named(tmp_path, monkeypatch):
    monkeypatch.setenv("UNDERSTUDY_CACHE", str(tmp_path))
    monkeypatch.setitem(sys.modules, "anny", None)
    with pytest.raises(MissingExtraError, match="train"):
        run(str(tmp_path / "out"), "--bodies", "anny", "--body-count", "2")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtraError, match="train"):
        run("--speed")
