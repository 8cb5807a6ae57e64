"""Simulated hands: laws of their anatomy, of what holds them, of the crops; and the training on them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("anny")

from scipy.spatial.transform import Rotation  # noqa: E402

from understudy.errors import ModelFileError, UnderstudyError  # noqa: E402
from understudy.hands import pool as pools  # noqa: E402
from understudy.hands import training  # noqa: E402
from understudy.hands.crop import CELL, CONTEXT, EMPTY, GREY, PIXEL, PIXELS, HandView, crop_rotation  # noqa: E402
from understudy.hands.net import HandNormalNet, loss, von_mises_fisher  # noqa: E402
from understudy.hands.pool import HandPool, PoolConfig  # noqa: E402
from understudy.hands.training import HandTrainConfig, HandTrainer, _cut, _some_unknown, inputs, relit, varied  # noqa: E402
from understudy.skeleton import HAND_KEYPOINTS, JOINT  # noqa: E402
from understudy.synthetic.bodies import load_bank  # noqa: E402
from understudy.synthetic.draw import Draw  # noqa: E402
from understudy.synthetic.hand_bank import FOREARM, articulate, load_hands, palm_normals, shortest_turn  # noqa: E402
from understudy.synthetic.hand_boxes import carried_between  # noqa: E402
from understudy.synthetic.hand_clothes import LOWER, SKIN, UPPER, ClothesConfig, dress_hands  # noqa: E402
from understudy.synthetic.hand_color import color_words  # noqa: E402
from understudy.synthetic.hand_crops import crop_rotation as torch_crop_rotation  # noqa: E402
from understudy.synthetic.hand_crops import depth_crop  # noqa: E402
from understudy.synthetic.hand_grips import BAR, FREE, Board, GripConfig, draw_board, draw_grips, held_points, turned  # noqa: E402
from understudy.synthetic.hand_images import HandScene, hand_image  # noqa: E402
from understudy.synthetic.hand_samples import HandBatch, HandConfig, HandSamples  # noqa: E402
from understudy.synthetic.render import FAR, pixel_rays, splat, splat_which  # noqa: E402
from understudy.synthetic.segments import SEGMENT, SEGMENTS  # noqa: E402

STRAIGHT = torch.tensor([[-1.0, 0.0, 0.0]])


@pytest.fixture(scope="module")
def bank():
    return load_hands(6, 77, 900)


@pytest.fixture(scope="module")
def samples(bank):
    return HandSamples(load_bank("anny", 6, 77), bank, seed=5)


@pytest.fixture(scope="module")
def batch(samples):
    return samples.batch(0, 96)


def _still(bank, n=6):
    ids = torch.arange(n)
    return ids, articulate(bank, ids, torch.zeros(n, 5, 3), torch.zeros(n, 5), STRAIGHT.expand(n, 3))


def test_hand_frame(bank):
    """x to the middle knuckle, z out of the palm, right hands: thumb at -y."""
    marks = bank.landmarks
    row = HAND_KEYPOINTS.index
    assert marks[:, row("wrist")].abs().max() == 0
    middle = marks[:, row("middle_1")]
    assert (middle[:, 0] > 0.06).all() and middle[:, 1:].abs().max() < 1e-4
    assert (marks[:, row("thumb_4"), 1] < 0).all() and (marks[:, row("pinky_1"), 1] > 0).all()
    np.testing.assert_allclose(palm_normals(marks)[:, 2], 1.0, atol=0.02)
    length = (marks[:, row("middle_4")] - marks[:, 0]).norm(dim=1)
    assert ((length > 0.15) & (length < 0.23)).all()  # ANSUR: 0.18 to 0.21


def test_nothing_bent_is_as_at_rest(bank):
    ids, posed = _still(bank)
    torch.testing.assert_close(posed.points, bank.points[ids], atol=1e-5, rtol=0)
    torch.testing.assert_close(posed.landmarks, bank.landmarks[ids], atol=1e-5, rtol=0)


def test_fingers_bend_towards_the_palm_and_keep_their_bones(bank):
    ids, still = _still(bank)
    flex = torch.full((6, 5, 3), 0.7)
    bent = articulate(bank, ids, flex, torch.zeros(6, 5), STRAIGHT.expand(6, 3))
    tips = [8, 12, 16, 20]
    assert (bent.landmarks[:, tips, 2] > still.landmarks[:, tips, 2] + 0.01).all()
    for a, b in ((5, 6), (6, 7), (7, 8), (17, 18), (1, 2)):
        before = (still.landmarks[:, a] - still.landmarks[:, b]).norm(dim=1)
        torch.testing.assert_close((bent.landmarks[:, a] - bent.landmarks[:, b]).norm(dim=1), before, atol=1e-4, rtol=0)
    torch.testing.assert_close(palm_normals(bent.landmarks), palm_normals(still.landmarks), atol=1e-5, rtol=0)


def test_forearm_points_to_the_elbow_and_the_hand_stays(bank):
    ids, still = _still(bank)
    elbow = torch.nn.functional.normalize(torch.tensor([[-1.0, 0.3, -0.9]]), dim=1).expand(6, 3)
    bent = articulate(bank, ids, torch.zeros(6, 5, 3), torch.zeros(6, 5), elbow)
    arm = bank.weights[:, FOREARM] > 0.99
    far = arm & (bank.points[0, :, 0] < -0.08)
    torch.testing.assert_close(
        bent.points[:, bank.weights[:, FOREARM] == 0], still.points[:, bank.weights[:, FOREARM] == 0]
    )
    way = torch.nn.functional.normalize(bent.points[:, far].mean(1), dim=1)
    assert ((way * elbow).sum(1) > 0.97).all()
    assert 0.1 < float((~bank.of_hand).float().mean()) < 0.6


def test_shortest_turn():
    end = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    start = torch.tensor([0.0, 0.6, 0.8])
    R = shortest_turn(start, end)
    torch.testing.assert_close((R @ start[:, None])[..., 0], end, atol=1e-5, rtol=0)
    angle = Rotation.from_matrix(R.numpy()).magnitude()
    np.testing.assert_allclose(angle, np.arccos((end @ start).numpy().clip(-1, 1)), atol=1e-4)


def test_wrists_turn_no_further_than_wrists_do():
    axes = torch.eye(3).expand(4000, 3, 3)
    elbow = STRAIGHT.expand(4000, 3)
    out = turned(Draw(3), 0.5, axes, elbow)
    torch.testing.assert_close(out @ out.mT, axes, atol=1e-5, rtol=0)
    assert torch.linalg.det(out).min() > 0.99
    assert (out[:, 0, 0] > 0.09).all()
    changed = (out - axes).abs().amax((1, 2)) > 1e-6
    assert 0.35 < float(changed.float().mean()) < 0.5


def test_what_is_held_touches_the_hand(bank):
    draw = Draw(1)
    grips = draw_grips(draw, GripConfig(holds=0.5), torch.full((300,), 0.3))
    ids = draw.integers(len(bank), 300)
    hand = articulate(bank, ids, grips.flex, grips.spread, STRAIGHT.expand(300, 3))
    held = held_points(draw, grips, hand.landmarks)
    free = grips.kind == FREE
    assert held[free].isnan().all() and held[~free].isfinite().all()
    assert 0.35 < float((~free).float().mean()) < 0.65
    gap = torch.cdist(hand.points[~free], held[~free]).amin((1, 2))
    assert gap.max() < 0.02
    bar = grips.kind == BAR
    assert (held[bar][..., 2] > 0.02).all()  # before the palm


def test_board_is_where_rays_meet_it():
    """Against a dense cloud of its points."""
    draw = Draw(2)
    grips = draw_grips(draw, GripConfig(), torch.zeros(8))
    board = draw_board(draw, GripConfig(handle=1.0, lies=1.0), grips)
    board = replace(board, there=torch.ones(8, dtype=torch.bool))
    turn = torch.tensor(Rotation.random(8, random_state=4).as_matrix()).float()
    board = board.moved(turn, torch.tensor([[0.0, 0.0, 2.0]]).expand(8, 3))
    scale, size = torch.full((8,), 300.0), 60
    z = board.cast(pixel_rays(scale, size))
    rays = pixel_rays(scale, size)
    hit = z < FAR
    assert hit.any()
    spot = (rays * z[..., None] - board.center[:, None, None]) @ board.axes[:, None].mT
    assert spot[hit][:, 2].abs().max() < 1e-4
    half = board.half[:, None, None].expand(8, size, size, 2)
    assert (spot[hit][:, :2].abs() <= half[hit] + 1e-4).all()
    absent = Board(board.center, board.axes, board.half, ~board.there)
    assert (absent.cast(rays) == FAR).all()


def test_what_both_hands_carry_lies_against_their_palms():
    """Palms that face each other have it between them, palms that look upwards have it on them; others have nothing."""

    def turned_about(axis: str, degrees: float) -> torch.Tensor:
        return torch.tensor(Rotation.from_euler(axis, degrees, degrees=True).as_matrix()).float()

    rotations = torch.eye(3).expand(3, len(SEGMENTS), 3, 3).clone()  # palms down
    for side, inwards in (("right", -90), ("left", 90)):
        rotations[0, SEGMENT[f"{side}_hand"]] = turned_about("y", inwards)
        rotations[1, SEGMENT[f"{side}_hand"]] = turned_about("x", 180)
    joints = torch.zeros(3, 18, 3)
    joints[:, JOINT["right_wrist"]] = torch.tensor([-0.2, -0.4, 1.0])
    joints[:, JOINT["left_wrist"]] = torch.tensor([0.2, -0.4, 1.0])
    joints[:, [JOINT["right_hip"], JOINT["left_hip"]]] = torch.tensor([0.0, 0.0, 0.9])
    carried = carried_between(Draw(4), 1.0, joints, rotations)
    assert carried.there.tolist() == [True, True, False]
    center, half = carried.boxes.center[:, 0], carried.boxes.half[:, 0]
    assert half[0, 0] == pytest.approx(0.2 - 0.03, abs=1e-5) and center[0, 0] == pytest.approx(0, abs=1e-5)
    assert center[1, 2] - half[1, 2] == pytest.approx(1.03, abs=1e-5)  # its bottom, over the palms' skin
    assert ((center[:2, 1] + 0.4).abs() < half[:2, 1]).all()  # the palms are within its depth
    assert center[2, 2] < -50  # sunk
    assert not carried_between(Draw(4), 0.0, joints, rotations).there.any()


def test_batches_are_functions_of_their_number(samples, batch):
    again = samples.batch(0, 96)
    for a, b in zip(batch, again, strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(samples.batch(1, 96).normal, batch.normal)


def test_truth_agrees_with_itself(batch):
    torch.testing.assert_close(palm_normals(batch.landmarks), batch.normal, atol=1e-4, rtol=0)
    middle = torch.nn.functional.normalize(batch.landmarks[:, 9] - batch.landmarks[:, 0], dim=1)
    assert ((middle * batch.direction).sum(1) > 0.999).all()
    for direction in (batch.normal, batch.direction):
        torch.testing.assert_close(direction.norm(dim=1), torch.ones(96), atol=1e-4, rtol=0)
    assert ((batch.visible >= 0) & (batch.visible <= 1)).all()
    mask = batch.depth[:, 1] > 0
    assert (batch.depth[:, 0][~mask] == EMPTY).all() and (batch.depth[:, 0][mask] < EMPTY).all()
    forearm = batch.context[:, 0] - batch.context[:, 1]
    assert (forearm[:, 0].abs() < 1e-3).float().mean() > 0.85  # upwards, unless it points at the camera


def test_seen_hands_are_in_the_crop_at_their_depth(batch):
    """The landmarks of hands in plain view lie just behind measured cells."""
    seen = (batch.visible > 0.7) & batch.in_view & (batch.grip == 0)
    marks, depth = batch.landmarks[seen][:, [0, 5, 9, 13, 17]], batch.depth[seen]
    distance = batch.distance[seen][:, None]
    cell = (marks[..., :2] * distance / (distance + marks[..., 2:]) / CELL + 24).floor().long()
    inside = ((cell >= 1) & (cell < 47)).all(-1)
    hits = []
    for n, k in inside.nonzero().tolist():
        x, y = cell[n, k].tolist()
        patch = depth[n, 0, y - 1 : y + 2, x - 1 : x + 2]
        near = patch[patch < EMPTY]
        if len(near):
            hits.append(float((near - marks[n, k, 2]).abs().min()))
    assert len(hits) > 20
    assert np.median(hits) < 0.02


def test_torch_and_numpy_crops_are_the_same():
    rng = np.random.default_rng(0)
    joints = rng.normal(0, 0.25, (18, 3)) + [0.1, 0, 2.5]
    view = HandView.of(joints, "right")
    points = view.center + rng.normal(0, 0.1, (3000, 3))
    seen = torch.tensor(points @ view.R.T).float()[None]
    torch_crop = depth_crop(seen, torch.ones(1, 3000, dtype=torch.bool), torch.tensor([view.distance]).float())[
        0
    ].numpy()
    own = view.depth_crop(points)
    assert (
        np.abs(own - torch_crop) > 1e-5
    ).mean() < 1e-3  # a point on a cell's very edge may be rounded to either side
    up = torch.tensor(view.center - points[0])
    up = up / up.norm()
    R = torch_crop_rotation(torch.tensor(view.center)[None], up[None])[0].numpy()
    np.testing.assert_allclose(R, crop_rotation(view.center, up.numpy()), atol=1e-9)


def test_splat_knows_the_point_that_is_seen():
    """Each pixel's point is the nearest of those whose 2 x 2 pixels cover it."""
    points = torch.randn(2, 60, 3, generator=torch.Generator().manual_seed(2)) * 0.1 + torch.tensor([0.0, 0.0, 2.0])
    points[0, 3] = torch.nan
    scale, size = torch.full((2,), 100.0), 24
    z, which = splat_which(points, scale, size)
    torch.testing.assert_close(z, splat(points, torch.zeros(2, 60, dtype=torch.bool), scale, size)[0])
    assert ((which < 0) == (z > FAR - 1)).all() and (which >= 0).any() and not (which[0] == 3).any()
    for b, v, u in (which >= 0).nonzero().tolist():
        point = points[b, which[b, v, u]]
        assert abs(float(point[2] - z[b, v, u])) < 1e-3
        corner = point[:2] / point[2] * 100 + size / 2 - 1
        assert 0 <= u - corner[0].floor() <= 1 and 0 <= v - corner[1].floor() <= 1


def test_pockets_begin_at_an_edge_and_hide_what_is_beyond(bank):
    """Sleeves cover forearms, pockets the fingers' side; cloth is between a hand without a shape and the camera."""
    b = 400
    along = bank.points[torch.zeros(b, dtype=torch.long), :, 0]
    to_camera = torch.nn.functional.normalize(torch.randn(b, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    empty = torch.arange(b) % 2 == 0
    config = ClothesConfig(sleeves=0.5, pockets=0.5, pockets_at_hips=1.0)
    worn = dress_hands(Draw(1), config, along, bank.of_hand, empty, torch.full((b,), 0.1), to_camera)
    assert not worn.pocketed[~empty].any() and worn.pocketed[empty].any(1).float().mean() > 0.95
    assert not worn.pocketed[:, ~bank.of_hand].any()
    some = worn.pocketed.any(1)
    least = torch.where(worn.pocketed, along, 9.0).amin(1)[some]
    bare = bank.of_hand & ~worn.pocketed[some]
    assert (torch.where(bare, along[some], -9.0).amax(1) <= least).all()
    assert (bare.any(1)).float().mean() > 0.5
    assert (worn.wear[worn.pocketed] != SKIN).all() and (worn.wear == LOWER).any() and (worn.wear == UPPER).any()
    assert ((worn.thick == 0) == (worn.wear == SKIN)).all()
    flat = worn.patch.there
    assert torch.equal(flat, worn.thick.isnan().any(1))
    across = to_camera * torch.tensor([0.0, 1.0, 1.0])
    fingers = torch.tensor([0.13, 0.0, 0.0])  # a place on the fingers: the cloth is before it
    gap = ((worn.patch.center - fingers) * worn.patch.axes[:, 2]).sum(1)
    facing = (torch.nn.functional.normalize(across, dim=1) * worn.patch.axes[:, 2]).sum(1)
    easy = flat & (across.norm(dim=1) > 0.6)
    assert (facing[easy] > 0.3).float().mean() > 0.95 and (gap[easy] > 0).float().mean() > 0.8


def test_pockets_hide_hands(bank):
    bodies = load_bank("anny", 6, 77)

    def batch(share: float) -> HandBatch:
        config = HandConfig(clothes=ClothesConfig(pockets=share, pockets_at_hips=share), grips=GripConfig(holds=0.0))
        return HandSamples(bodies, bank, config, seed=5).batch(0, 48)

    bare, pocketed = batch(0.0), batch(1.0)
    assert torch.equal(bare.normal, pocketed.normal) and not torch.equal(bare.image, pocketed.image)
    assert (pocketed.visible <= bare.visible + 0.05).float().mean() > 0.95
    assert float(pocketed.visible.mean()) < 0.6 * float(bare.visible.mean())


def test_cloth_before_a_hand_has_the_wearers_colour():
    """A board all over the image: of one colour with folds when it is cloth, of any otherwise."""
    nothing = torch.full((40, 1, 3), torch.nan)
    near, far = torch.full((40, PIXELS, PIXELS), 1.0), torch.full((40, PIXELS, PIXELS), FAR)
    scene = HandScene(
        nothing, nothing, torch.full((40, 1), SKIN), torch.tensor([[0.0, 0.0, 1.0]]).expand(40, 3), nothing, nothing,
        torch.zeros(1, dtype=torch.long), far, near, torch.full((40,), LOWER), torch.full((40,), 2.0),
        torch.full((40,), 0.001),
    )  # fmt: skip
    image = hand_image(Draw(3), scene).float().flatten(2)
    assert float(image.mean(2).std(0).min()) > 20  # everybody wears something else
    hue = image / image.sum(1, keepdim=True).clamp_min(1)
    bright = image.mean((1, 2)) > 60  # noise hides the colour of black cloth
    assert float(hue[bright].std(2).mean()) < 0.02


def test_some_depth_ends_at_a_line():
    gone = _cut(Draw(0), 2000)
    cut = gone.flatten(1).any(1)
    assert 0.08 < float(cut.float().mean()) < 0.16
    share = gone[cut].float().mean((1, 2))
    assert 0.4 < float(share.mean()) < 0.6 and float(share.max()) < 0.95


def test_boards_of_one_batch_replaced_by_those_of_another():
    draw, grips = Draw(2), draw_grips(Draw(1), GripConfig(), torch.zeros(8))
    first, second = (draw_board(draw, GripConfig(handle=h, lies=h), grips) for h in (1.0, 0.3))
    both = first.replaced_by(second)
    assert torch.equal(both.there, first.there | second.there)
    for name in ("center", "axes", "half"):
        mine, own, other = (getattr(x, name) for x in (both, first, second))
        assert torch.equal(mine[second.there], other[second.there])
        assert torch.equal(mine[~second.there], own[~second.there])


def test_images_show_the_hand_where_it_is():
    """A square of skin, half of it behind a box: its colour is where its points are, and not where the box is."""
    step = torch.linspace(-0.05, 0.05, 60)
    y, x = torch.meshgrid(step, step, indexing="ij")
    skin = torch.stack([x, y, torch.full_like(x, 2.0)], -1).reshape(1, -1, 3).expand(6, -1, 3)
    normals = torch.tensor([0.0, 0.0, -1.0]).expand_as(skin)
    boxes = torch.full((6, PIXELS, PIXELS), FAR)
    boxes[:, :, : PIXELS // 2] = 1.0
    scene = HandScene(
        skin, normals, torch.full(skin.shape[:2], SKIN), torch.tensor([[0.0, 0.0, 1.0]]).expand(6, 3),
        torch.full((6, 1, 3), torch.nan), torch.full((6, 1, 3), torch.nan), torch.zeros(1, dtype=torch.long),
        boxes, torch.full_like(boxes, FAR), torch.full((6,), -1), torch.full((6,), 2.0), torch.full((6,), 0.001),
    )  # fmt: skip
    image = hand_image(Draw(3), scene).float()
    middle, half = PIXELS // 2, int(0.05 / PIXEL)
    hand = image[:, :, middle - half + 3 : middle + half - 3, middle + 3 : middle + half - 3].flatten(2).median(2)[0]
    red, green, blue = hand.unbind(1)
    assert ((red > green) & (green > blue)).all()  # skin
    beside = image[:, :, middle - half + 3 : middle + half - 3, middle - half + 3 : middle - 3].flatten(2).median(2)[0]
    assert ((hand - beside).abs().amax(1) > 15).float().mean() > 0.8


def test_relit_images_stay_images():
    image = torch.full((400, 3, 4, 4), 128, dtype=torch.uint8)
    image[:, 0] = 200
    out = relit(Draw(0), image)
    assert out.min() >= 0 and out.max() <= 255
    none = (out == GREY).flatten(1).all(1)
    assert 0.1 < float(none.float().mean()) < 0.3
    colors = out[~none].mean((2, 3))
    assert float((colors[:, 0] - colors[:, 1]).median()) > 30


def test_unknown_joints_are_where_they_are_put_in_use():
    """As `HandView.of` does it: in the middle of the known ones; wrist and elbow are always known."""
    context = torch.randn(4000, len(CONTEXT), 3, generator=torch.Generator().manual_seed(0))
    out = _some_unknown(Draw(1), context)
    changed = (out != context).any(-1)
    assert not changed[:, :2].any() and 0.07 < float(changed.any(1).float().mean()) < 0.13
    for row in changed.any(1).nonzero()[:20, 0].tolist():
        middle = context[row][~changed[row]].mean(0)
        torch.testing.assert_close(out[row][changed[row]], middle.expand(int(changed[row].sum()), 3), atol=1e-5, rtol=0)


def test_variation_moves_everything_together(batch, monkeypatch):
    monkeypatch.setattr(training, "_UNKNOWN", 0.0)
    out = varied(Draw(8), batch)
    shift = (out.landmarks - batch.landmarks)[:, 0]
    torch.testing.assert_close(out.landmarks - batch.landmarks, shift[:, None].expand(-1, 21, 3))
    assert ((out.context - batch.context - shift[:, None]).abs() < 0.05).all()
    torch.testing.assert_close(out.distance[:, 0] - batch.distance[:, 0], -shift[:, 2])
    assert torch.equal(out.normal, batch.normal)
    cells = (shift[:, :2] / CELL).round().long()
    for k in range(8):
        du, dv = cells[k].tolist()
        before, after = batch.depth[k, 0], out.depth[k, 0]
        rows, columns = slice(max(dv, 0), 48 + min(dv, 0)), slice(max(du, 0), 48 + min(du, 0))
        source = before[max(-dv, 0) : 48 + min(-dv, 0), max(-du, 0) : 48 + min(-du, 0)]
        kept = after[rows, columns] < EMPTY
        expected = (source + shift[k, 2]).clamp_max(0.2)[kept]
        torch.testing.assert_close(after[rows, columns][kept], expected, atol=1e-4, rtol=0)


def test_variation_moves_the_image_as_the_depth(batch, monkeypatch):
    monkeypatch.setattr("understudy.hands.training.relit", lambda draw, image: image)
    out = varied(Draw(8), batch)
    shift = (out.landmarks - batch.landmarks)[:, 0, :2]
    pixels = (shift / PIXEL).round().long()
    torch.testing.assert_close(pixels * PIXEL, shift, atol=1e-5, rtol=0)
    for k in range(8):
        du, dv = pixels[k].tolist()
        moved = out.image[k][:, 8:-8, 8:-8]
        assert torch.equal(moved, batch.image[k][:, 8 - dv : PIXELS - 8 - dv, 8 - du : PIXELS - 8 - du])


def test_color_words_err_as_measured():
    n = 6000
    normal = torch.nn.functional.normalize(torch.randn(n, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    direction = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.randn(n, 3)), dim=1)
    words = color_words(Draw(1), normal, direction, torch.full((n,), 0.8), torch.full((n,), 40.0), absent=0.0)
    found = words[:, 8] == 1
    assert (words[~found] == 0).all()
    assert 0.68 < float(found.float().mean()) < 0.78
    error = torch.rad2deg(torch.acos((words[found, :3] * normal[found]).sum(1).clamp(-1, 1)))
    assert 9 < float(error.median()) < 17
    assert 0.04 < float((error > 60).float().mean()) < 0.2
    assert words[found, 7][error < 30].mean() > words[found, 7][error > 60].mean() + 0.2  # the quality tells
    hidden = color_words(Draw(1), normal, direction, torch.zeros(n), torch.full((n,), 40.0), absent=0.0)
    assert float((hidden[:, 8] == 1).float().mean()) < 0.15


# -- network and training ------------------------------------------------------------------------------------------


def test_von_mises_fisher_is_a_density():
    """Its integral over the sphere is the same constant for every concentration."""
    cos = torch.linspace(-1, 1, 20001, dtype=torch.float64)
    areas = []
    for log_kappa in (-1.0, 1.0, 3.0):
        density = torch.exp(-von_mises_fisher(cos, torch.full_like(cos, log_kappa)))
        areas.append(float(torch.trapezoid(density, cos)))
    np.testing.assert_allclose(areas, areas[0], rtol=1e-3)


def test_loss_wants_the_truth(batch):
    net = HandNormalNet().eval()
    out = net(*inputs(batch, torch.zeros(96, 9)))
    right = out._replace(normal=batch.normal, direction=batch.direction, landmarks=batch.landmarks)
    wrong = right._replace(normal=-batch.normal)
    assert (
        loss(right, batch.normal, batch.direction, batch.landmarks)[0]
        < loss(wrong, batch.normal, batch.direction, batch.landmarks)[0]
    )


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(pools, "SHARD", 32)
    monkeypatch.setattr("understudy.hands.training.SHARD", 32)
    monkeypatch.setattr(pools, "_BATCH", 16)
    return HandTrainConfig(
        data=PoolConfig(bodies=6, hands=6, bank_seed=77), shards=2, epochs=3, batch=16, warmup=2, validation_shards=1,
        validate_every=4, checkpoint_every=2, log_every=1, workers=1,
    )  # fmt: skip


def _filled(config: HandTrainConfig, out: Path, monkeypatch: pytest.MonkeyPatch) -> HandTrainer:
    bodies, hands = load_bank("anny", 6, 77), load_hands(6, 77, 900)
    monkeypatch.setattr(pools, "load_bank", lambda *a: bodies)
    monkeypatch.setattr(pools, "load_hands", lambda *a: hands)
    monkeypatch.setattr(pools, "_SAMPLES", {})
    trainer = HandTrainer(config, out)
    for pool in trainer.pools():
        pool.fill()
    return trainer


def test_training_begins_with_given_weights(tiny, tmp_path, monkeypatch):
    given = _filled(tiny, tmp_path / "a", monkeypatch)
    given.run()
    path = tmp_path / "a" / "weights.safetensors"
    on = HandTrainer(replace(tiny, init=str(path)), tmp_path / "b")
    for name, value in given.average.items():
        assert torch.equal(on.net.state_dict()[name], value), name
    (tmp_path / "bad.safetensors").write_bytes(b"no weights")
    with pytest.raises(ModelFileError, match="bad.safetensors: not readable weights"):
        HandTrainer(replace(tiny, init=str(tmp_path / "bad.safetensors")), tmp_path / "c")


def test_training_learns_resumes_and_refuses_other_settings(tiny, tmp_path, monkeypatch):
    rows: list[dict] = []
    whole = _filled(tiny, tmp_path / "whole", monkeypatch).run(rows.append)
    log = [r for r in rows if "loss" in r]
    assert len(log) == HandTrainer(tiny, tmp_path / "whole").steps and log[-1]["loss"] < log[0]["loss"]
    assert any("all_mean" in r for r in rows)

    stopped = _filled(tiny, tmp_path / "parts", monkeypatch)

    def stop(step: int) -> None:
        if step == 5:
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        stopped.run(progress=stop)
    again = HandTrainer(tiny, tmp_path / "parts")
    assert again.step == 4  # the last checkpoint
    resumed = again.run()
    for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-5)
    with pytest.raises(UnderstudyError, match="learning_rate"):
        HandTrainer(replace(tiny, learning_rate=1.0), tmp_path / "parts")
    (tmp_path / "parts" / "config.json").write_text(json.dumps({"config": {}}))
    with pytest.raises(UnderstudyError, match="another network"):
        HandTrainer(tiny, tmp_path / "parts")


def test_publishing_calibrates_and_writes_what_runs(tiny, tmp_path, monkeypatch):
    from understudy.hands.predictor import HandPredictor
    from understudy.hands.publish import publish

    _filled(tiny, tmp_path / "run", monkeypatch).run()
    made = publish(tmp_path / "run", tmp_path / "out")
    assert [p.name for p in made] == ["handnormalnet.safetensors", "handnormalnet.onnx", "MODEL_CARD.md"]
    assert "all_mean" in made[2].read_text()
    HandPredictor(made[1])
    with pytest.raises(UnderstudyError, match="not a training run"):
        publish(tmp_path, tmp_path / "out")


def test_pool_is_made_once_and_refuses_other_settings(tiny, tmp_path, monkeypatch):
    trainer = _filled(tiny, tmp_path / "run", monkeypatch)
    pool = trainer.pools()[0]
    times = [p.stat().st_mtime_ns for p in sorted(pool.folder.glob("0*.safetensors"))]
    done: list[int] = []
    pool.fill(progress=done.append)
    assert done == [2] and times == [p.stat().st_mtime_ns for p in sorted(pool.folder.glob("0*.safetensors"))]
    hands = pool.load()
    assert isinstance(hands, HandBatch) and len(hands.depth) == 64 and hands.depth.dtype == torch.float16
    with pytest.raises(UnderstudyError, match="other settings"):
        HandPool(pool.folder, replace(tiny.data, seed=9), 2).fill()
