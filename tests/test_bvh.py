"""Motion-capture files: reading, forward kinematics against known angles, retargeting, damaged files."""

from __future__ import annotations

import itertools
import random
import warnings
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from scipy.spatial.transform import Rotation

from understudy.errors import RecordingError, UnderstudyError
from understudy.synthetic.bvh import load_folder, map_joints, read_bvh, retarget
from understudy.synthetic.segments import SEGMENT

CHAIN = """HIERARCHY
ROOT Hips
{{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition {order}
  JOINT Arm
  {{
    OFFSET 1 2 3
    CHANNELS 3 {order}
    End Site
    {{
      OFFSET 0.5 -1 2
    }}
  }}
}}
MOTION
Frames: 2
Frame Time: 0.02
{rows}
"""

# a T-posed body in a y-up file: name, parent, offset
BODY = (
    ("Hips", "", (0, 90, 0)),
    *(
        (name.format(side), parent.format(side), (sign * x, y, z))
        for side, sign in (("Left", 1), ("Right", -1))
        for name, parent, (x, y, z) in (
            ("{}UpLeg", "Hips", (9, 0, 0)),
            ("{}Leg", "{}UpLeg", (0, -42, 0)),
            ("{}Foot", "{}Leg", (0, -41, 0)),
            ("{}ToeBase", "{}Foot", (0, -6.0, 10.24)),
            ("{}Shoulder", "Spine2", (2, 22, 0)),
            ("{}Arm", "{}Shoulder", (16, 0, 0)),
            ("{}ForeArm", "{}Arm", (30, 0, 0)),
            ("{}Hand", "{}ForeArm", (25, 0, 0)),
        )
    ),
    ("Spine", "Hips", (0, 12, 0)),
    ("Spine2", "Spine", (0, 14, 0)),
    ("Neck", "Spine2", (0, 24, 0)),
    ("Head", "Neck", (0, 9, 0)),
)


def body_text(turns: dict[str, tuple[float, float, float]], rename=lambda name: name, axes=(0, 1, 2)) -> str:
    """A file with one frame; `turns` are ZXY angles in degrees; `axes` permutes the file's world."""
    children = {name: [c for c, parent, _ in BODY if parent == name] for name, _, _ in BODY}
    offset = {name: np.array(o, float)[list(axes)] for name, _, o in BODY}
    lines, values = ["HIERARCHY"], []

    def write(name: str, kind: str) -> None:
        lines.extend([f"{kind} {rename(name)}", "{", "OFFSET " + " ".join(f"{v:.6f}" for v in offset[name])])
        place = "Xposition Yposition Zposition " if kind == "ROOT" else ""
        names = [f"{'XYZ'[axes.index(k)]}rotation" for k in (2, 0, 1)]
        lines.append(f"CHANNELS {6 if place else 3} {place}{' '.join(names)}")
        values.extend([1.0, 2.0, 3.0] if place else [])
        values.extend(turns.get(name, (0.0, 0.0, 0.0)))
        for child in children[name]:
            write(child, "JOINT")
        if not children[name]:
            lines.extend(["End Site", "{", "OFFSET 1 0 0", "}"])
        lines.append("}")

    write("Hips", "ROOT")
    lines.extend(["MOTION", "Frames: 1", "Frame Time: 0.0333333", " ".join(f"{v:.6f}" for v in values)])
    return "\n".join(lines) + "\n"


def body(tmp_path: Path, **options):
    path = tmp_path / "body.bvh"
    path.write_text(body_text(**options))
    return read_bvh(path)


@pytest.mark.parametrize("order", ["".join(p) for p in itertools.permutations("XYZ")])
def test_known_angles_give_known_positions(tmp_path, order):
    rows = np.array([[1, 2, 3, 10, -20, 30, 40, 50, -60], [-3, 0, 7, 80, 15, -35, -120, 5, 33]], float)
    path = tmp_path / "chain.bvh"
    names = " ".join(f"{axis}rotation" for axis in order)
    path.write_text(CHAIN.format(order=names, rows="\n".join(" ".join(map(str, r)) for r in rows)))
    bvh = read_bvh(path)
    assert bvh.names == ("Hips", "Arm", "Arm_end") and bvh.parents == (-1, 0, 1) and bvh.frame_time_s == 0.02
    root, arm = (Rotation.from_euler(order, rows[:, i : i + 3], degrees=True) for i in (3, 6))
    joint = rows[:, :3] + root.apply([1, 2, 3])
    end = joint + (root * arm).apply([0.5, -1, 2])
    np.testing.assert_allclose(bvh.positions(), np.stack([rows[:, :3], joint, end], 1), atol=1e-9)
    np.testing.assert_allclose(bvh.rotations([1])[0, 1], (root * arm).as_matrix()[1], atol=1e-9)


def test_rest_posture_is_the_canonical_one(tmp_path):
    rotations = retarget(body(tmp_path, turns={}))
    assert rotations.shape == (1, 21, 3, 3)
    np.testing.assert_allclose(rotations[0], np.broadcast_to(np.eye(3), (21, 3, 3)), atol=0.03)


def test_known_turns_of_single_joints(tmp_path):
    # file axes: x left, y up, z front; ours: x left, y back, z up
    turns = {"Hips": (0, 0, 70), "LeftForeArm": (0, 0, -90), "RightLeg": (0, 60, 0), "Head": (0, 0, 40)}
    r = retarget(body(tmp_path, turns=turns))[0]
    assert r[SEGMENT["pelvis"]] == pytest.approx(np.eye(3), abs=0.02)  # heading removed
    np.testing.assert_allclose(r[SEGMENT["left_forearm"]] @ [1, 0, 0], [0, -1, 0], atol=0.02)
    np.testing.assert_allclose(r[SEGMENT["right_shin"]] @ [0, 0, -1], [0, np.sin(np.pi / 3), -0.5], atol=0.02)
    facing = r[SEGMENT["head"]] @ [0, -1, 0]
    np.testing.assert_allclose(facing, [np.sin(np.radians(40)), -np.cos(np.radians(40)), 0], atol=0.03)


LIMBS = ("UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand")


def renamed(left: str, right: str):
    """A renaming of the limbs: the left ones' names, and what stands for 'left' in the right ones'."""
    table = {}
    for ours, name in zip(LIMBS, left.split(), strict=True):
        table[f"Left{ours}"] = name
        was = {"R": "L", "_R": "_L", "right": "left"}[right]
        table[f"Right{ours}"] = (
            name.removesuffix(was) + right if name.endswith(was) and right == "_R" else right + name.removeprefix(was)
        )
    return lambda n: table.get(n, n)


@pytest.mark.parametrize(
    "rename",
    [
        lambda n: f"mixamorig:{n}",
        lambda n: f"mixamorig{n}",
        lambda n: n.lower(),
        renamed("LHip LKnee LAnkle LToe LCollar LShoulder LElbow LWrist", "R"),
        renamed("UpperLeg_L LowerLeg_L Foot_L Toes_L Shoulder_L UpperArm_L LowerArm_L Hand_L", "_R"),
        renamed("left_hip left_knee left_ankle left_foot left_collar left_shoulder left_elbow left_wrist", "right"),
    ],
    ids=["mixamo", "mixamo_plain", "lower_case", "short", "bandai_rokoko", "smpl"],
)  # fmt: skip
def test_names_of_other_programs(tmp_path, rename):
    turns = {"LeftForeArm": (0, 0, -90)}
    np.testing.assert_allclose(
        retarget(body(tmp_path, turns=turns, rename=rename)), retarget(body(tmp_path, turns=turns)), atol=1e-5
    )


def test_z_up_files(tmp_path):
    turns = {"LeftForeArm": (0, 0, -90), "RightUpLeg": (0, -50, 0)}
    # cyclic: the file's x, y, z are the y-up file's z, x, y
    np.testing.assert_allclose(
        retarget(body(tmp_path, turns=turns, axes=(2, 0, 1))), retarget(body(tmp_path, turns=turns)), atol=1e-5
    )


def test_names_that_are_not_there_are_listed(tmp_path):
    bvh = body(tmp_path, turns={}, rename=lambda n: n.replace("LeftHand", "Klaue"))
    with pytest.raises(UnderstudyError, match=r"left_hand.*Klaue"):
        retarget(bvh)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda t: "", "HIERARCHY"),
        (lambda t: t.replace("HIERARCHY", "HIERACHY"), "line 1.*HIERARCHY"),
        (lambda t: t.replace("OFFSET 9.000000", "OFFSET nine", 1), "OFFSET of"),
        (lambda t: t.replace("CHANNELS 3", "CHANNELS 4", 1), "announces 4"),
        (lambda t: t.replace("Xrotation", "Wrotation", 1), "Wrotation"),
        (lambda t: t.replace("Frames: 1", "Frames: 2"), "announces 2 frames"),
        (lambda t: t.replace("Frames: 1", "Frames: 1e999"), "finite"),
        (lambda t: t.replace("Frame Time: 0.0333333", "Frame Time: 0"), "Frame Time"),
        (lambda t: t.rstrip() + " 5\n", "numbers"),
        (lambda t: t.replace("1.000000 2.000000 3.000000", "1.000000 nan 3.000000"), "finite"),
        (lambda t: t.replace("JOINT Neck", "JOINT Spine2"), "twice"),
        (lambda t: t[: t.index("MOTION")], "ends"),
        (lambda t: t.replace("}\nMOTION", "MOTION"), "not closed"),
    ],
)
def test_damaged_files_say_what_is_wrong(tmp_path, change, message):
    path = tmp_path / "bad.bvh"
    path.write_text(change(body_text({})))
    with pytest.raises(RecordingError, match=rf"(?s)bad\.bvh, line \d+.*{message}|line \d+.*{message}|{message}"):
        read_bvh(path)


def test_missing_file(tmp_path):
    with pytest.raises(RecordingError, match=r"no\.bvh"):
        read_bvh(tmp_path / "no.bvh")
    with pytest.raises(RecordingError, match="folder"):
        load_folder(tmp_path / "nowhere")


def test_fuzzed_files_never_break_otherwise(tmp_path):
    text = body_text({"LeftArm": (10, 20, 30)})
    rng = random.Random(0)
    path = tmp_path / "fuzz.bvh"
    junk = (
        "{",
        "}",
        "JOINT",
        "End Site",
        "nan",
        "-1",
        "1e400",
        "MOTION",
        "\x00",
        "é",
        "CHANNELS 3",
        "",
        "Frames: 9",
        "inf",
    )
    for _ in range(250):
        kind = rng.randrange(4)
        words = text.split("\n")
        i = rng.randrange(len(words))
        if kind == 0:
            words[i] = rng.choice(junk)
        elif kind == 1:
            del words[i : i + rng.randrange(1, 6)]
        elif kind == 2:
            parts = words[i].split(" ")
            parts[rng.randrange(len(parts))] = rng.choice(junk)
            words[i] = " ".join(parts)
        changed = "\n".join(words)
        if kind == 3:
            changed = changed[: rng.randrange(len(changed))]
        path.write_bytes(changed.encode())
        try:
            result = retarget(read_bvh(path))
        except UnderstudyError:
            continue
        assert np.isfinite(result).all()


def test_folder_skips_damaged_files(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "good.bvh").write_text(body_text({}))
    (tmp_path / "bad.BVH").write_text("HIERARCHY\nROOT Hips\n{\n")
    with pytest.warns(UserWarning, match="bad.BVH"):
        assert load_folder(tmp_path).shape == (1, 21, 3, 3)


@pytest.fixture(scope="module")
def cmu() -> Path:
    path = SHARED / "cmu_bvh"
    if not path.is_dir():
        pytest.skip(f"the recordings {path} are not on this machine")
    return path


def test_retargeting_keeps_the_directions_of_real_motion(cmu):
    path = sorted(cmu.rglob("*.bvh"))[0]
    bvh = read_bvh(path)
    frames = np.arange(0, len(bvh.frames), 25)
    r = retarget(bvh, frames).astype(float)
    np.testing.assert_allclose(r @ np.swapaxes(r, -1, -2), np.broadcast_to(np.eye(3), r.shape), atol=1e-5)
    at, joints = bvh.positions(frames), map_joints(bvh)
    world = np.stack([at[..., 0], -at[..., 2], at[..., 1]], -1)  # y up -> z up
    chains = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        chains += [(f"{side}_thigh", f"{side}_shin", (0, 0, -1)), (f"{side}_shin", f"{side}_foot", (0, 0, -1))]
        chains += [
            (f"{side}_upper_arm", f"{side}_forearm", (sign, 0, 0)),
            (f"{side}_forearm", f"{side}_hand", (sign, 0, 0)),
        ]
    true = np.stack([world[:, joints[b]] - world[:, joints[a]] for a, b, _ in chains], 1)
    true /= np.linalg.norm(true, axis=-1, keepdims=True)
    ours = np.stack([r[:, SEGMENT[a]] @ np.array(axis) for a, _, axis in chains], 1)
    for t, o in zip(true, ours, strict=True):  # one turn about the vertical explains all
        c = np.sum(t[:, 0] * o[:, 0] + t[:, 1] * o[:, 1]), np.sum(t[:, 0] * o[:, 1] - t[:, 1] * o[:, 0])
        turned = Rotation.from_euler("z", np.arctan2(c[1], c[0])).apply(t)
        assert np.degrees(np.arccos(np.clip((turned * o).sum(-1), -1, 1))).max() < 1.0
    hips = r[:, SEGMENT["pelvis"], :, 0]
    assert np.degrees(np.abs(np.arctan2(hips[:, 1], hips[:, 0]))).max() < 25


def test_real_folder(cmu):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rotations = load_folder(cmu, every_s=0.5)
    assert len(rotations) > 40 and rotations.dtype == np.float32
    torch = pytest.importorskip("torch")
    from understudy.synthetic.kinematics import within_limits

    assert within_limits(torch.as_tensor(rotations)).float().mean() > 0.9
