import csv
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from understudy import plots
from understudy.benchmark import ALL, Timed, benchmark, precomputed
from understudy.camera import Camera, RGBDCamera
from understudy.errors import MissingExtraError, RecordingError, UnderstudyError
from understudy.metrics import METRICS, metric_values
from understudy.people_file import FramePeople, PeopleFile
from understudy.recordings import write_recording
from understudy.recordings.truth import Truth, TruthPerson
from understudy.skeleton import JOINTS, N_JOINTS
from understudy.types import INFERRED, MISSING, OBSERVED, Frame, Keypoints2D, Palm, Person

PNG = b"\x89PNG\r\n\x1a\n"
METHODS = {"exact": 0.02, "coarse": 0.06, "naive": 0.04}
"""method -> standard deviation of its joints per axis, metres"""


@dataclass(frozen=True)
class FakeRecording:
    name: str
    truth: Truth | None
    path: Path = Path("nowhere")


def recording(name: str, frames: int = 20, seed: int = 0) -> FakeRecording:
    rng = np.random.default_rng(seed)
    return FakeRecording(name, Truth({i: tuple(true_person(rng, k) for k in range(2)) for i in range(frames)}))


def true_person(rng: np.random.Generator, id: int) -> TruthPerson:
    keypoints = rng.normal(0, 0.4, (N_JOINTS, 3)) + (3.0 * id, 0, 3)
    palms = {s: np.array([0.0, 0.0, -1.0]) for s in ("left", "right")}
    in_view = rng.uniform(size=N_JOINTS) < 0.9
    return TruthPerson(id, keypoints, in_view, rng.uniform(size=N_JOINTS) < 0.3, palms, {"left": True, "right": True})


def predicted_person(truth: TruthPerson, method: str, rng: np.random.Generator) -> Person:
    sigma = METHODS[method] * np.where(truth.occluded, 2.0, 1.0)
    keypoints = truth.keypoints + rng.normal(size=(N_JOINTS, 3)) * sigma[:, None]
    left_out = (truth.occluded | ~truth.in_view) & (method == "naive")
    keypoints[left_out] = np.nan
    within = np.linalg.norm(rng.normal(size=(4000, 3)), axis=-1)
    confidence = np.array([np.mean(within * s < 0.1) for s in sigma])
    confidence[left_out] = 0
    return Person(
        Keypoints2D(np.ones((N_JOINTS, 2)), np.ones(N_JOINTS)),
        keypoints,
        confidence,
        np.where(left_out, np.nan, sigma),
        tuple(MISSING if m else INFERRED if o else OBSERVED for m, o in zip(left_out, truth.occluded, strict=True)),
        truth.id,
        {"left": None if method == "naive" else Palm(np.array([0.0, np.sin(0.2), -np.cos(0.2)]), 0.9), "right": None},
    )


def estimate(recording: FakeRecording, method: str) -> Timed:
    rng = np.random.default_rng(1)
    frames = tuple(
        FramePeople(i, tuple(predicted_person(p, method, rng) for p in people if rng.uniform() < 0.95))
        for i, people in recording.truth.frames.items()
    )
    return Timed(PeopleFile(method, recording.name, frames), ms_per_frame=12.5)


@pytest.fixture(scope="module")
def result_and_folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("benchmark") / "made" / "here"
    return benchmark([recording("kitchen"), recording("office", 10, 7)], list(METHODS), out, estimate), out


def test_rows_per_recording_and_pooled(result_and_folder):
    result, _ = result_and_folder
    assert [(r.recording, r.method) for r in result.rows] == [
        (name, method) for name in ("kitchen", "office", ALL) for method in METHODS
    ]
    assert [r.method for r in result.summary] == list(METHODS) and {r.recording for r in result.summary} == {ALL}
    kitchen, office, pooled = (result.rows[i].evaluation.joints["all"] for i in (0, 3, 6))
    assert pooled.n_truth == kitchen.n_truth + office.n_truth == 60 * 18
    expected = (kitchen.n_given * kitchen.epe_m + office.n_given * office.epe_m) / pooled.n_given
    assert pooled.epe_m == pytest.approx(expected)
    assert result.rows[-1].ms_per_frame == pytest.approx(12.5)


def test_terminal_table_fits_and_has_units(result_and_folder):
    table = result_and_folder[0].table()
    lines = table.splitlines()
    assert max(map(len, lines)) <= 120
    heads, units = lines[1], lines[2]
    for head, unit in (("EPE", "cm"), ("given", "%"), ("bones", "deg"), ("time", "ms/frame")):
        end = heads.index(head) + len(head)
        assert units[:end].endswith(unit) or unit == "ms/frame"
    assert lines[0] == "kitchen: 40 people in 20 frames"
    naive = next(line for line in lines if line.startswith("naive")).split()
    assert naive[3] == naive[4] == "-"  # it gives neither occluded joints nor joints out of view


def test_files(result_and_folder):
    result, out = result_and_folder
    assert {p.name for p in out.iterdir()} == {
        "table.md", "table.csv", "results.json", "pck.png", "joints.png", "calibration.png",
    }  # fmt: skip
    for name in ("pck", "joints", "calibration"):
        assert (out / f"{name}.png").read_bytes().startswith(PNG)
    rows = list(csv.DictReader((out / "table.csv").open()))
    assert len(rows) == 9 and rows[0]["recording"] == "kitchen" and rows[2]["epe_cm_occluded"] == ""
    values = metric_values(result.rows[0].evaluation)
    assert float(rows[0]["epe_cm_all"]) == pytest.approx(values["epe_cm_all"], rel=1e-5)
    assert float(rows[0]["ms_per_frame"]) == 12.5
    text = (out / "table.md").read_text()
    for part in ("EPE cm", "left wrist", "Matching:", "Wall time", "flipped %", "cores", f"## {ALL}"):
        assert part in text
    assert text.count("## ") == 5


def test_results_json_says_what_it_means_and_where_it_ran(result_and_folder):
    _, out = result_and_folder
    data = json.loads((out / "results.json").read_text())
    assert data["format"] == "benchmark/1" and "0.5 m" in data["matching"]
    assert data["command"] and data["versions"]["numpy"] == np.__version__ and data["hardware"]["cores"] >= 1
    assert set(data["definitions"]) == {m.key for m in METRICS} | {"ms_per_frame"} == set(data["rows"][0]["metrics"])
    row = data["rows"][2]
    assert row["method"] == "naive" and row["metrics"]["epe_cm_occluded"] is None
    assert set(row["joints"]) == set(JOINTS)
    assert len(row["pck_curves_percent"]["visible"]) == len(data["pck_thresholds_cm"]) == 201
    given = sum(round(j["joints"] * j["coverage_percent"] / 100) for j in row["joints"].values())
    assert sum(row["calibration_bins"]["joints"]) == given


def test_recordings_by_path(tmp_path):
    camera = RGBDCamera.aligned(Camera.from_fov(8, 6, 1.0))
    frames = [Frame(np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), np.float32), camera, i) for i in range(2)]
    known = recording("known", 2)
    write_recording(tmp_path / "known", frames, truth=known.truth)
    write_recording(tmp_path / "blind", frames)
    result = benchmark([tmp_path / "known"], ["exact"], None, lambda r, m: estimate(known, m))
    assert result.rows[0].recording == "known" and result.rows[0].evaluation.joints["all"].n_truth == 2 * 2 * 18
    with pytest.raises(RecordingError, match=r"blind/truth\.json: no such file"):
        benchmark([str(tmp_path / "blind")], ["exact"], None, estimate)


def test_neither_the_estimator_nor_matplotlib_is_needed_to_import_it():
    code = "import sys, understudy.benchmark; assert not {'matplotlib', 'understudy.estimator'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_benchmark_times_what_is_not_timed_and_writes_nothing_unasked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = []
    one = recording("one", 3)
    result = benchmark([one], ["exact"], None, lambda r, m: estimate(r, m).people, progress=said.append)
    assert len(result.rows) == 1 and 0 < result.rows[0].ms_per_frame < 10_000
    assert said == ["one: exact"] and not list(tmp_path.iterdir())


def test_precomputed_people():
    one = recording("one", 3)
    known = {("one", "exact"): estimate(one, "exact").people}
    result = benchmark([one], ["exact"], None, precomputed(known))
    assert result.rows[0].ms_per_frame is None and result.table().splitlines()[3].endswith("-")
    with pytest.raises(UnderstudyError, match=r"no people were estimated for \('one', 'coarse'\)"):
        benchmark([one], ["coarse"], None, precomputed(known))


def test_what_cannot_be_compared(tmp_path):
    def never(recording, method):
        raise AssertionError("must not be called")

    good, blind = recording("good", 1), FakeRecording("blind", None, tmp_path / "blind")
    with pytest.raises(RecordingError, match=r"blind/truth\.json: no such file"):
        benchmark([good, blind], ["exact"], None, never)
    with pytest.raises(RecordingError, match="two recordings are named 'good'"):
        benchmark([good, good], ["exact"], None, never)
    with pytest.raises(UnderstudyError, match="no recording"):
        benchmark([], ["exact"], None, never)
    with pytest.raises(UnderstudyError, match="at least one, each once"):
        benchmark([good], ["exact", "exact"], None, never)


def test_plots_say_which_part_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"understudy\[plots\]"):
        benchmark([recording("one", 1)], ["exact"], tmp_path, estimate)
    assert benchmark([recording("one", 1)], ["exact"], tmp_path, estimate, plots=False).rows
    assert {p.name for p in tmp_path.iterdir()} == {"table.md", "table.csv", "results.json"}


def test_plots_of_methods_that_found_nobody():
    nobody = recording("nobody", 2)
    result = benchmark([nobody], ["exact"], None, precomputed({("nobody", "exact"): PeopleFile("exact", "nobody")}))
    evaluations = {"exact": result.rows[0].evaluation}
    for plot in (plots.pck_curves, plots.joint_bars, plots.calibration):
        assert plot(evaluations, "nobody").startswith(PNG)
