"""Training: resumes bit for bit, refuses what does not fit, runs in two processes, keeps its tables; its commands."""

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from safetensors.torch import load_file, save_file  # noqa: E402

from understudy.cli import main  # noqa: E402
from understudy.cli.common import needs_extra  # noqa: E402
from understudy.errors import MissingExtraError, ModelFileError, UnderstudyError  # noqa: E402
from understudy.skeleton import JOINTS  # noqa: E402
from understudy.voxelposenet import records, validation  # noqa: E402
from understudy.voxelposenet.checkpoint import FORMAT, load_net, save_weights  # noqa: E402
from understudy.voxelposenet.data import Batches  # noqa: E402
from understudy.voxelposenet.net import VoxelPoseNet  # noqa: E402
from understudy.voxelposenet.train_config import differences, from_json  # noqa: E402
from understudy.voxelposenet.training import PRESETS, TrainConfig, Trainer, read_config  # noqa: E402

SMALL = replace(
    PRESETS["smoke"], steps=8, batch=2, plots=False, validation_samples=1, validate_every=100, checkpoint_every=3
)


@pytest.fixture(autouse=True, scope="module")
def quiet(tmp_path_factory):
    """One thread, and a cache of bodies of our own."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("UNDERSTUDY_CACHE", str(tmp_path_factory.getbasetemp() / "bodies"))
        yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A run that nothing interrupted."""
    out = tmp_path_factory.mktemp("runs") / "finished"
    Trainer(SMALL, out).run()
    return out


def interrupted(config: TrainConfig, out: Path, at: int) -> Trainer:
    """A run that got Ctrl-C during step `at`."""
    trainer = Trainer(config, out)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(progress=lambda step: signal.raise_signal(signal.SIGINT) if step == at else None)
    return trainer


def same(a: Path, b: Path, name: str) -> bool:
    one, two = load_file(a / name), load_file(b / name)
    return one.keys() == two.keys() and all(torch.equal(one[k], two[k]) for k in one)


# --- going on ---


def test_interrupted_and_resumed_is_bit_for_bit_the_same(finished, tmp_path):
    """Weights, their average, the optimiser. With a plain copy, the optimiser's state would be in another order."""
    handler = signal.getsignal(signal.SIGINT)
    first = interrupted(SMALL, tmp_path, 4)
    assert first.step == 4 and signal.getsignal(signal.SIGINT) is handler
    assert not same(finished, tmp_path, "weights.safetensors")
    second = Trainer(SMALL, tmp_path)
    assert second.step == 4
    second.run()
    assert same(finished, tmp_path, "weights.safetensors") and same(finished, tmp_path, "checkpoint.safetensors")
    for name in ("validation.csv", "validation_joints.csv"):
        kept, again = records.read(finished / name), records.read(tmp_path / name)
        assert [{k: v for k, v in r.items() if k != "hours"} for r in kept] == [
            {k: v for k, v in r.items() if k != "hours"} for r in again
        ]
    assert [r["step"] for r in records.read(tmp_path / "log.csv")] == [str(i + 1) for i in range(8)]


def test_what_is_done_is_not_done_again(finished):
    before = {p.name: p.read_bytes() for p in finished.iterdir() if p.name != "config.json"}
    Trainer(SMALL, finished).run()
    assert {p.name: p.read_bytes() for p in finished.iterdir() if p.name != "config.json"} == before


def test_a_validation_that_was_missed_is_made_up_for(finished, tmp_path):
    for path in finished.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "validation.csv").unlink()
    rows: list = []
    Trainer(SMALL, tmp_path).run(rows.append)
    assert [r["step"] for r in rows] == [8] and len(records.read(tmp_path / "validation.csv")) == 1


@pytest.mark.parametrize("damage", ["cut", "empty", "text", "other", "names", "half", "optimiser"])
def test_damaged_checkpoint(finished, tmp_path, damage):
    for name in ("config.json", "checkpoint.safetensors"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    path = tmp_path / "checkpoint.safetensors"
    content = path.read_bytes()
    if damage == "names":
        save_file({"elsewhere/a": torch.zeros(1)}, path, {"step": "3", "seconds": "1"})
    elif damage == "half":  # without Muon's momentum
        tensors = {k: v for k, v in load_file(path).items() if not k.startswith("optimizer2/")}
        save_file(tensors, path, {"step": "3", "seconds": "1"})
    elif damage == "optimiser":  # what another one remembers
        tensors = load_file(path)
        tensors["optimizer/0/exp_avg"] = torch.zeros(3, 3)
        save_file(tensors, path, {"step": "3", "seconds": "1"})
    elif damage == "other":
        tensors = load_file(path)
        tensors["net/score.weight"] = torch.zeros(1, 2, 3)
        save_file(tensors, path, {"step": "3", "seconds": "1"})
    else:
        path.write_bytes({"cut": content[: len(content) // 2], "empty": b"", "text": b"weights\n" * 100}[damage])
    with pytest.raises(ModelFileError, match="checkpoint.safetensors: not a"):
        Trainer(SMALL, tmp_path)


def test_a_run_begins_with_given_weights(finished, tmp_path):
    given = finished / "weights.safetensors"
    trainer = Trainer(replace(SMALL, init=str(given), seed=5), tmp_path / "on")
    for net in (trainer.net, trainer.averaged()):
        state = net.state_dict()
        assert all(torch.equal(state[k], v) for k, v in load_file(given).items())
    other = replace(SMALL, init=str(given), net=replace(SMALL.net, lifted=3))
    with pytest.raises(ModelFileError, match=r"weights\.safetensors: .*lifted=2.* must be .*lifted=3"):
        Trainer(other, tmp_path / "other")


@pytest.mark.parametrize("fewer", [{"floor": False, "refinement": 0}, {"refinement": 0}])
def test_a_smaller_network_is_where_a_larger_one_begins(tmp_path, fewer):
    """At first it takes no notice of the floor and refines nothing; then it learns to."""
    old = VoxelPoseNet(replace(SMALL.net, **fewer)).eval()
    save_weights(tmp_path / "old.safetensors", old.state_dict(), old.config, {})
    words = json.loads(json.dumps(asdict(old.config)))
    for name in fewer:
        del words[name]  # as it was before there was one
    save_file(old.state_dict(), tmp_path / "older.safetensors", {"format": FORMAT, "net": json.dumps(words)})
    batch = Batches(SMALL.data, 3, 0, 1)[0]
    for name in ("old", "older"):
        trainer = Trainer(replace(SMALL, init=str(tmp_path / f"{name}.safetensors"), steps=1), tmp_path / name)
        given = (batch.depth, batch.keypoints, batch.root_z)
        for a, b in zip(trainer.averaged()(*given, batch.floor), old(*given, batch.floor), strict=True):
            torch.testing.assert_close(a, b)
        trainer.run()
        assert (trainer.net.first.weight[:, -3:] != 0).any()
        assert (trainer.net.refinement.leave.weight != 0).any()
    with pytest.raises(ModelFileError, match="floor=True.*refinement=3.* must be "):
        Trainer(
            replace(SMALL, init=str(tmp_path / "old" / "weights.safetensors"), net=replace(SMALL.net, **fewer)),
            tmp_path / "back",
        )


def test_runs_from_before_the_floor_and_the_refinement_are_without_them(finished, tmp_path):
    about = json.loads((finished / "config.json").read_text())
    assert about["config"]["net"].pop("floor") and about["config"]["net"].pop("refinement")
    (tmp_path / "config.json").write_text(json.dumps(about))
    assert read_config(tmp_path / "config.json").net == replace(SMALL.net, floor=False, refinement=0)


def test_a_run_goes_on_without_the_weights_that_it_began_with(finished, tmp_path):
    given = tmp_path / "given.safetensors"
    given.write_bytes((finished / "weights.safetensors").read_bytes())
    config = replace(SMALL, init=str(given), seed=5, steps=2)
    Trainer(config, tmp_path / "run").run()
    given.unlink()
    assert Trainer(config, tmp_path / "run").step == 2


def test_runs_from_before_muon_are_adamws(finished, tmp_path):
    about = json.loads((finished / "config.json").read_text())
    del about["config"]["optimizer"]
    (tmp_path / "config.json").write_text(json.dumps(about))
    assert read_config(tmp_path / "config.json").optimizer == "adamw"
    (tmp_path / "fields.json").write_text('{"steps": 7}')
    assert read_config(tmp_path / "fields.json").optimizer == "muon"


def test_training_is_compiled_when_asked(tmp_path, monkeypatch):
    """Compiling takes a minute, and not with these tests' type checks: whether it is asked for is what is tested."""
    monkeypatch.setenv("CXX", sys.executable)
    asked = []
    monkeypatch.setattr(torch.nn.Module, "compile", lambda net, *a, **k: asked.append(type(net).__name__))
    for choice in (False, True):
        Trainer(replace(SMALL, steps=1, compile=choice), tmp_path / str(choice)).run()
    assert asked == ["_Learning"]


def test_without_a_compiler_training_is_only_slower(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.warns(UserWarning, match="'no-such-compiler' was not found"):
        Trainer(replace(SMALL, steps=1, compile=True), tmp_path / "run").run()
    assert (tmp_path / "run/weights.safetensors").exists()


def test_another_configuration_does_not_mix(finished):
    for config, words in (
        (replace(SMALL, batch=3), "another batch (2, now 3)"),
        (replace(SMALL, data=replace(SMALL.data, bodies="both")), "another data.bodies ('capsules', now 'both')"),
        (replace(SMALL, net=replace(SMALL.net, lifted=3)), "another net.lifted (2, now 3)"),
        (replace(SMALL, seed=9), "another seed (0, now 9)"),
    ):
        with pytest.raises(UnderstudyError, match=re.escape(words)):
            Trainer(config, finished)
    assert Trainer(replace(SMALL, steps=20, workers=2, log_every=5), finished).step == 8


def test_a_run_without_the_newer_settings_goes_on(finished, tmp_path):
    """config.json of before there were other networks and schedules."""
    data = json.loads((finished / "config.json").read_text())
    for name in ("network", "schedule", "decay_every", "grid", "plots"):
        del data["config"][name]
    (tmp_path / "config.json").write_text(json.dumps(data))
    assert differences(read_config(tmp_path / "config.json"), SMALL) == {}


def test_a_loss_that_is_no_number_stops(tmp_path):
    with pytest.raises(UnderstudyError, match="the loss is nan"):
        Trainer(replace(SMALL, learning_rate=1e30, warmup=0, clip=0.0, bf16=False), tmp_path).run()


# --- together ---

_TOGETHER = """
import sys
from dataclasses import replace
from pathlib import Path
import torch
torch.set_num_threads(1)
from safetensors.torch import save_file
from understudy.voxelposenet.training import PRESETS, Trainer
trainer = Trainer(replace(PRESETS["smoke"], steps=3, batch=2, plots=False, validation_samples=1), Path(sys.argv[1]))
trainer.run()
tensors = {k: v.detach().contiguous() for k, v in trainer.net.named_parameters()}
save_file(tensors, f"{sys.argv[1]}/{trainer.world.rank}")
trainer.close()
"""


def test_two_processes_have_the_same_weights(tmp_path):
    script = tmp_path / "together.py"
    script.write_text(_TOGETHER)
    out = tmp_path / "run"
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    done = subprocess.run(
        [*command, str(script), str(out)],
        env={**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True, text=True, timeout=170, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, second = load_file(out / "0"), load_file(out / "1")
    assert first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)
    assert [r["step"] for r in records.read(out / "log.csv")] == ["1", "2", "3"]
    assert [r["step"] for r in records.read(out / "validation.csv")] == ["3"]
    assert json.loads((out / "config.json").read_text())["processes"] == 2
    torch.manual_seed(0)
    alone = Trainer(replace(PRESETS["smoke"], steps=3, batch=2), tmp_path / "alone").net
    assert not torch.equal(first["score.weight"], alone.score.weight)


# --- schedules and averages ---


def test_learning_rates():
    c = TrainConfig(steps=1000, learning_rate=1e-2, warmup=100)
    assert c.rate(0) == pytest.approx(1e-4) and c.rate(99) == pytest.approx(1e-2) == c.rate(100)
    assert c.rate(550) == pytest.approx(1e-2 * (0.01 + 0.99 / 2))
    assert c.rate(1000) == pytest.approx(1e-4) == c.rate(5000)
    paper = PRESETS["paper"]
    expected = {0: 1e-4, 9_999: 1e-4, 10_000: 1e-5, 25_000: 1e-6, 39_999: 1e-7}
    assert {k: paper.rate(k) for k in expected} == pytest.approx(expected)
    assert (paper.batch, paper.steps, paper.weight_decay, paper.network) == (2, 40_000, 0, "paper-fast")


def test_moving_average(tmp_path):
    c = TrainConfig(ema=0.9)
    assert [c.average_share(i) for i in (0, 10, 1000)] == pytest.approx([0.1, 0.55, 0.9])
    trainer = Trainer(replace(SMALL, ema=0.9), tmp_path)
    expected = {k: v.detach().clone() for k, v in trainer.net.named_parameters()}

    def follow(step):
        keep = min(0.9, step / (step + 9))
        for k, v in trainer.net.named_parameters():
            expected[k] = keep * expected[k] + (1 - keep) * v.detach()
        if step == 3:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt):
        trainer.run(progress=follow)
    for k, v in expected.items():
        torch.testing.assert_close(trainer.average[k], v, atol=1e-7, rtol=1e-5)
    saved = load_net(tmp_path / "weights.safetensors")
    assert torch.equal(saved.score.weight, trainer.average["score.weight"])


def test_without_a_moving_average(tmp_path):
    trainer = interrupted(replace(SMALL, ema=0.0), tmp_path, 2)
    assert all(torch.equal(trainer.average[k], v) for k, v in trainer.net.state_dict().items())


# --- configuration ---


def test_configurations_come_back_from_json():
    for config in PRESETS.values():
        assert from_json(json.loads(json.dumps(asdict(config))), TrainConfig(), "x") == config


@pytest.mark.parametrize(
    "fields, message",
    [
        ({"step": 3}, "there is no 'step'"),
        ({"steps": "3"}, "'steps' must be int"),
        ({"steps": 0}, "steps 0: must be at least 1"),
        ({"steps": True}, "'steps' must be int"),
        ({"network": "big"}, "network 'big': must be one of 'default'"),
        ({"schedule": "none"}, "schedule 'none'"),
        ({"ema": 1}, "ema 1.0: must be below 1"),
        ({"grid": 12}, "multiple of 8"),
        ({"data": {"bodies": "elves"}}, "bodies 'elves': must be one of"),
        ({"data": {"samples": {"sensors": ["sonar"]}}}, "must be some of kinect2"),
        ({"data": {"samples": {"scene": {"distance_m": 3}}}}, "'distance_m' must be a list"),
        ({"data": 3}, "'data' must be an object"),
        ({"learning_rate": float("inf")}, "learning_rate inf"),
    ],
)
def test_wrong_configurations_name_the_field(fields, message):
    with pytest.raises(UnderstudyError, match=re.escape(message)) as e:
        from_json(fields, TrainConfig(), "file.json")
    assert str(e.value).startswith("file.json")


def test_numbers_may_be_whole():
    c = from_json({"learning_rate": 1, "data": {"samples": {"scene": {"distance_m": [1, 2]}}}}, TrainConfig(), "x")
    assert c.learning_rate == 1.0 and c.data.samples.scene.distance_m == (1, 2)


# --- tables ---


def test_tables(tmp_path):
    path = tmp_path / "t.csv"
    records.append(path, [{"step": 1, "a": 2}, {"step": 2, "a": 3}])
    records.append(path, [{"step": 3, "a": 4, "b": 5}])  # a newer version's column
    records.append(path, [{"step": 4, "a": 6, "b": 7}])
    with path.open("a") as f:
        f.write("5,1")  # cut off
    assert [r["step"] for r in records.read(path)] == ["1", "2", "3", "4"]
    records.keep_until(path, 3)
    assert records.read(path) == [
        {"step": "1", "a": "2", "b": ""}, {"step": "2", "a": "3", "b": ""}, {"step": "3", "a": "4", "b": "5"},
    ]  # fmt: skip
    assert records.read(tmp_path / "absent.csv") == []


def test_breakdowns_add_up():
    rng = np.random.default_rng(0)
    n = 50
    r = validation.Results(
        error=rng.exponential(0.05, (n, 18)), mirrored=np.full((n, 18), 1.0), sigma=np.full((n, 18), 0.05),
        confidence=np.full((n, 18), 0.8), in_view=rng.random((n, 18)) < 0.9, occluded=rng.random((n, 18)) < 0.3,
        hard=rng.random(n) < 0.5, root_z=rng.uniform(1, 6, (n, 1)), tag=rng.integers(0, 4, (n, 2)),
    )  # fmt: skip
    total = validation.summary(r)
    for name, table in validation.TABLES.items():
        rows = table(r, ("kinect2",))
        assert sum(row["n"] for row in rows) == r.in_view.sum(), name
        mean = sum(row["n"] * row["all"] for row in rows) / r.in_view.sum()
        assert mean == pytest.approx(total["all"], abs=0.01)
    assert [row["joint"] for row in validation.joint_table(r)] == list(JOINTS)
    assert [row["in_training"] for row in validation.sensor_table(r, ("kinect2",))] == ["yes", "no", "no", "no"]
    hidden = r.in_view & r.occluded
    assert total["occluded"] == pytest.approx(100 * r.error[hidden].mean(), abs=1e-3)


def test_validation_has_other_people_and_every_sensor(tmp_path):
    data = replace(SMALL.data, samples=replace(SMALL.data.samples, sensors=("azure",)))
    held = Trainer(replace(SMALL, data=data), tmp_path)._validation()
    assert isinstance(held, Batches) and len(held) == 1
    assert len(torch.unique(next(iter(held)).tag[:, 0])) > 1


# --- commands ---


def test_train_command(tmp_path, capsys):
    """Trains, draws, goes on with more steps, exports, describes."""
    config = tmp_path / "small.json"
    config.write_text(json.dumps({"batch": 2, "validation_samples": 1, "validate_every": 100}))
    out = tmp_path / "run"
    arguments = ["train", str(out), "--preset", "smoke", "--config", str(config), "--without-sensor", "azure"]
    assert main([*arguments, "--steps", "2"]) == 0
    printed = capsys.readouterr()
    assert "step 2, 0.0" in printed.out and "occluded" in printed.out and "error" in printed.err
    for name in ("curves.png", "joints.png", "distance.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    assert read_config(out / "config.json").data.samples.sensors == ("kinect2", "realsense", "other")
    assert main(["train", str(out), "--steps", "3"]) == 0  # what is not said stays as it was
    assert "going on after step 2 of 3" in capsys.readouterr().err
    assert main(["train", str(out), "--preset", "smoke"]) == 2
    assert "the run there has another" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--preset", "large"], "preset 'large': must be one of 'default'"),
        (["--bodies", "elves"], "bodies 'elves'"),
        (["--without-sensor", "sonar"], "--without-sensor 'sonar': must be one of 'kinect2'"),
        (["--steps", "0"], "steps 0: must be at least 1"),
        (["--config", "absent.json"], "absent.json: no such file"),
        (["--device", "cuda"], "no CUDA device"),
    ],
)
def test_wrong_arguments(tmp_path, capsys, arguments, message):
    if "cuda" in arguments and torch.cuda.is_available():
        pytest.skip("there is one")
    assert main(["train", str(tmp_path / "run"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_what_is_not_installed_is_named(monkeypatch, capsys, tmp_path):
    with pytest.raises(MissingExtraError, match=r"understudy\[train\]"), needs_extra("x", "train"):
        import no_such_package  # noqa: F401
    with pytest.raises(ImportError) as e, needs_extra("x", "train"):
        from understudy import no_such_module  # noqa: F401
    assert not isinstance(e.value, MissingExtraError)
    monkeypatch.setitem(sys.modules, "safetensors", None)
    assert main(["weights", "info", str(tmp_path / "w.safetensors")]) == 2
    assert "understudy[train]" in capsys.readouterr().err


def test_bodies_that_cannot_be_built(monkeypatch):
    monkeypatch.setitem(sys.modules, "anny", None)
    with pytest.raises(MissingExtraError, match=r"bodies of the set 'anny'.*understudy\[train\]"):
        Batches(replace(SMALL.data, bodies="anny", anny=2), 1, 0, 1)
