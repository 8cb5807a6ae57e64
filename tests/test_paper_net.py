"""The paper's network against the authors' outputs, against numpy, and the reading of weights from elsewhere."""

import os
import pickle
import subprocess
import sys
import types
import zlib
from collections import OrderedDict

import numpy as np
import pytest
from conftest import SHARED

from understudy.errors import ModelFileError, UnderstudyError
from understudy.voxelposenet.tensorflow_weights import (
    expected_shapes,
    guess_variant,
    import_weights,
    read_paper_weights,
    save_paper_weights,
)

PARAMETERS = {"paper": 13_266_522, "paper-fast": 12_459_354}


def formula_weights(variant):
    """The weights of shared/data/vpn_oracle/README.md."""
    out = {}
    for name, shape in expected_shapes(variant).items():
        rng = np.random.RandomState(zlib.crc32(name.encode()) & 0x7FFFFFFF)
        if name.endswith("/biases"):
            values = 0.05 * rng.standard_normal(shape)
        else:
            fan = np.prod(shape[:4])
            if "upconv" in name or ("scorevolume" in name and "scorevolume_final/weights" not in name):
                fan = fan / (shape[0] / 2) ** 3
            values = rng.standard_normal(shape) * np.sqrt(2 / fan)
        out[name] = values.astype(np.float32)
    return out


def oracle_input():
    rng = np.random.RandomState(123)
    x = np.empty((1, 64, 64, 64, 19), np.float32)
    x[..., 0] = rng.rand(1, 64, 64, 64) < 0.03
    c = rng.rand(18, 2) * 64
    at = np.arange(64)
    for j in range(18):
        x[..., 1 + j] = np.exp(-((at[:, None] - c[j, 0]) ** 2 + (at - c[j, 1]) ** 2) / 9)[None, :, :, None]
    return x


@pytest.fixture(scope="module")
def fast():
    return formula_weights("paper-fast")


def paper_net(variant, weights=None):
    pytest.importorskip("torch")
    from understudy.voxelposenet.paper_net import PaperNet

    net = PaperNet(variant)
    if weights is not None:
        net.load_variables(weights)
    return net.eval()


def outputs(net, x):
    """TensorFlow's layout in and out."""
    import torch

    with torch.inference_mode():
        return [v.numpy().transpose(0, 2, 3, 4, 1) for v in net(torch.from_numpy(np.moveaxis(x, 4, 1).copy()))]


# --- the network ---


def test_agrees_with_the_authors_network(fast):
    path = SHARED / "vpn_oracle" / "fast.npz"
    if not path.is_file():
        pytest.skip(f"the authors' outputs {path} are not on this machine")
    volumes = outputs(paper_net("paper-fast", fast), oracle_input())
    with np.load(path) as oracle:
        where = (0, *oracle["idx"].T, oracle["channel"])
        for volume, expected in zip(volumes, oracle["outputs"], strict=True):
            np.testing.assert_allclose(volume[where], expected, rtol=0, atol=1e-4)
        best = volumes[-1].reshape(-1, 18).argmax(0)
        np.testing.assert_array_equal(np.stack(np.unravel_index(best, (64, 64, 64)), 1), oracle["argmax"])


@pytest.mark.parametrize("variant", PARAMETERS)
def test_number_of_parameters(variant):
    assert sum(int(np.prod(s)) for s in expected_shapes(variant).values()) == PARAMETERS[variant]
    assert sum(p.numel() for p in paper_net(variant).parameters()) == PARAMETERS[variant]


def same_convolution(x, weights, biases):
    """TensorFlow's conv3d, stride 1, SAME, from its definition. x: [x, y, z, in]."""
    k = weights.shape[0]
    before = (k - 1) // 2
    padded = np.pad(x, [(before, k - 1 - before)] * 3 + [(0, 0)])
    nx, ny, nz = x.shape[:3]
    out = np.zeros((nx, ny, nz, weights.shape[4])) + biases
    for a, b, c in np.ndindex(k, k, k):
        out += padded[a : a + nx, b : b + ny, c : c + nz] @ weights[a, b, c].astype(np.float64)
    return out


def same_transposed(x, weights, biases, stride):
    """TensorFlow's conv3d_transpose, SAME: the gradient of the strided convolution to its input, which pads
    max((n - 1) stride + k - n stride, 0) cells for n outputs, the smaller half before. x: [x, y, z, in].
    """
    k = weights.shape[0]
    size = np.array(x.shape[:3]) * stride
    before = max(k - stride, 0) // 2
    full = np.zeros((*(size + k), weights.shape[3]))
    for at in np.ndindex(*x.shape[:3]):
        a, b, c = np.array(at) * stride
        full[a : a + k, b : b + k, c : c + k] += weights @ x[at]
    a, b, c = size + before
    return full[before:a, before:b, before:c] + biases


def by_numpy(x, weights, convolutions):
    """The whole network as the issue describes it, in TensorFlow's layout. x: [x, y, z, 19]."""

    def layer(name):
        return weights[f"VoxelPoseNet/{name}/weights"], weights[f"VoxelPoseNet/{name}/biases"]

    def conv(name, x):
        return same_convolution(x, *layer(name))

    def leaky(x):
        return np.where(x > 0, x, 0.01 * x)

    skips = []
    for block, n in enumerate(convolutions, 1):
        block_input = x
        earlier = []
        for i in range(1, n + 1):
            earlier.append(leaky(conv(f"conv{block}_{i}", np.concatenate([block_input, *earlier], -1))))
        nx, ny, nz, channels = earlier[-1].shape
        x = earlier[-1].reshape(nx // 2, 2, ny // 2, 2, nz // 2, 2, channels).max((1, 3, 5))
        skips.append(x)
    total, volumes = 0, []
    for level, stride, skip in ((1, 8, skips[1]), (2, 4, skips[0])):
        total = total + same_transposed(conv(f"det{level}", x), *layer(f"scorevolume{level}"), stride)
        volumes.append(total)
        x = np.concatenate([same_transposed(x, *layer(f"upconv{level}"), 2), skip], -1)
        x = leaky(conv(f"conv_decoder{level}", x))
    x = same_transposed(x, *layer("upconv_final"), 2)
    return [*volumes, total + conv("scorevolume_final", x)]


@pytest.mark.parametrize("variant, convolutions", [("paper", (2, 2, 2)), ("paper-fast", (1, 1, 2))])
def test_agrees_with_numpy(variant, convolutions):
    """Also where the authors' outputs are absent, and for the variant that they do not cover."""
    weights = formula_weights(variant)
    x = np.random.default_rng(0).random((8, 16, 8, 19), np.float32)
    got = outputs(paper_net(variant, weights), x[None])
    for volume, expected in zip(got, by_numpy(x, weights, convolutions), strict=True):
        np.testing.assert_allclose(volume[0], expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name, stride", [("scorevolume1", 8), ("scorevolume2", 4), ("upconv_final", 2)])
def test_transposed_convolution_is_tensorflows(name, stride, fast):
    torch = pytest.importorskip("torch")
    net = paper_net("paper-fast", fast)
    w, b = (fast[f"VoxelPoseNet/{name}/{part}"] for part in ("weights", "biases"))
    x = np.random.default_rng(1).standard_normal((2, 3, 1, w.shape[4])).astype(np.float32)
    with torch.inference_mode():
        got = net[name](torch.from_numpy(x.transpose(3, 0, 1, 2).copy())[None])[0].numpy().transpose(1, 2, 3, 0)
    assert got.shape[:3] == (2 * stride, 3 * stride, stride)
    np.testing.assert_allclose(got, same_transposed(x, w, b, stride), rtol=0, atol=1e-4)


def test_transposed_convolutions_begin_as_enlargement():
    torch = pytest.importorskip("torch")
    net = paper_net("paper-fast")
    with torch.no_grad():
        got = net["scorevolume2"](torch.ones(1, 18, 4, 4, 4))
    np.testing.assert_allclose(got[:, :, 4:-4, 4:-4, 4:-4], 1, atol=1e-6)


def test_variables_and_state_are_the_same_weights(fast):
    net = paper_net("paper-fast", fast)
    back = net.variables()
    assert list(back) == list(fast)
    for name in fast:
        np.testing.assert_array_equal(back[name], fast[name])
    assert set(net.state_dict()) == {
        name.removeprefix("VoxelPoseNet/").replace("/weights", ".weight").replace("/biases", ".bias") for name in fast
    }


def test_unknown_variant():
    with pytest.raises(UnderstudyError, match="'fast': must be one of 'paper', 'paper-fast'"):
        paper_net("fast")


# --- loss ---


def test_loss():
    torch = pytest.importorskip("torch")
    from understudy.voxelposenet.paper_net import paper_loss, target_volumes

    index = torch.rand(2, 18, 3) * 8
    index[0, 3] = torch.tensor([4.0, 7.0, 2.0])
    index[1, 5] = torch.nan
    target = target_volumes(index, (8, 12, 10))
    assert target[0, 3, 4, 7, 2] == 1
    assert target[0, 3, 4, 7, 5] == pytest.approx(np.exp(-1))  # 3 cells away
    assert target[0, 3, 1, 7, 2] == pytest.approx(np.exp(-1))
    assert float(paper_loss((target,) * 3, index)) == 0
    zeros = torch.zeros_like(target)
    assert float(paper_loss((zeros, target, zeros), index)) == pytest.approx(float(target.square().sum()), rel=1e-5)
    wild = target.clone()
    wild[1, 5] = 7.0  # its truth is unknown
    assert float(paper_loss((wild, wild, wild), index)) == 0


def test_learns():
    torch = pytest.importorskip("torch")
    from understudy.voxelposenet.paper_net import PaperNet, paper_loss

    torch.manual_seed(0)
    net = PaperNet("paper-fast")
    x, index = torch.rand(1, 19, 8, 8, 8), torch.rand(1, 18, 3) * 8
    optimiser = torch.optim.Adam(net.parameters(), 1e-4)
    losses = []
    for _ in range(12):
        optimiser.zero_grad()
        loss = paper_loss(net(x), index)
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.7 * losses[0]
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())


# --- weights from elsewhere ---


def assert_same(got, expected):
    assert list(got) == list(expected)
    for name in expected:
        assert got[name].dtype == np.float32
        np.testing.assert_array_equal(got[name], expected[name])


@pytest.mark.parametrize("variant", PARAMETERS)
def test_import_npz(tmp_path, variant):
    weights = formula_weights(variant)
    optimiser = {n: np.zeros(3) for n in ("VoxelPoseNet/det1/biases/Adam_1", "beta1_power", "global_step")}
    np.savez(tmp_path / "w.npz", **weights, **optimiser)
    assert guess_variant(weights) == variant
    assert_same(import_weights(tmp_path / "w.npz"), weights)
    assert_same(import_weights(tmp_path / "w.npz", variant), weights)


@pytest.mark.parametrize("separator", ["/", ".", "__"])
@pytest.mark.parametrize("scope", ["VoxelPoseNet/", ""])
def test_import_folder(tmp_path, fast, separator, scope):
    for name, array in fast.items():
        path = tmp_path / (name.replace("VoxelPoseNet/", scope).replace("/", separator) + ".npy")
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, array)
    assert_same(import_weights(tmp_path), fast)


def python_2(data, protocol):
    """numpy's old module names, as in files that are ten years old."""
    assert protocol < 4  # no frames, names in plain lines
    return pickle.dumps(data, protocol).replace(b"cnumpy._core.", b"cnumpy.core.")


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_import_pickle(tmp_path, fast, protocol):
    path = tmp_path / "w.pkl"
    # protocol 0 is text and slow: the small half of the variables shows as much
    small = {n: a for n, a in fast.items() if protocol > 2 or a.size < 3e4}
    path.write_bytes(pickle.dumps({**small, "global_step": np.int64(40000)}, protocol))
    from understudy.voxelposenet.array_pickle import read_pickle

    got = read_pickle(path)
    assert got.pop("global_step") == 40000
    assert_same(got, small)


def test_import_pickle_nested(tmp_path, fast):
    layers = {}
    for name, array in fast.items():
        _, layer, part = name.split("/")
        layers.setdefault(layer, {})[part] = np.asfortranarray(array)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"VoxelPoseNet": OrderedDict(layers)}, 4))
    assert_same(import_weights(tmp_path / "a.pkl"), fast)
    pairs = {layer: [parts["weights"], parts["biases"].astype(">f8")] for layer, parts in layers.items()}
    (tmp_path / "b.pickle").write_bytes(python_2(pairs, 2))
    assert_same(import_weights(tmp_path / "b.pickle"), fast)


class Call:
    """Unpickling calls function(*args)."""

    def __init__(self, function, *args, state=None):
        self.parts = (function, args) if state is None else (function, args, state)

    def __reduce__(self):
        return self.parts


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("nested", [False, True])
def test_malicious_pickle_is_refused_and_not_run(tmp_path, protocol, nested):
    marker = tmp_path / "executed"
    for i, call in enumerate(
        (
            Call(os.mkdir, str(marker)),
            Call(os.system, f"touch {marker}"),
            Call(eval, f"open({str(marker)!r}, 'w')"),
            Call(np.save, str(marker), 1),
            Call(getattr, OrderedDict, "__init__"),
        )
    ):
        path = tmp_path / f"{i}.pkl"
        path.write_bytes(pickle.dumps({"a": {"b": call}} if nested else call, protocol))
        with pytest.raises(ModelFileError, match="refused: the pickle asks for") as e:
            import_weights(path)
        assert str(path) in str(e.value)
    assert not list(tmp_path.glob("executed*"))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x80\x04",
        pickle.dumps({"a": np.array([1, "x"], object)}),
        pickle.dumps({"a": np.array(["x"])}),
        pickle.dumps({1: np.zeros(3)}),
        pickle.dumps([np.zeros(3)]),
        pickle.dumps({"a": "text"}),
        pickle.dumps({}),
        pickle.dumps(np.zeros(3), 4).replace(b"\x18\x00\x00\x00", b"\x19\x00\x00\x00"),
        b"cnumpy\nndarray\n}b.",  # sets attributes of the class
        b"cnumpy.core.multiarray\n_reconstruct\n(N}S'__defaults__'\nNstb.",  # and of a function
        b"cnumpy\nndarray\n)\x81.",  # an instance without __init__
        b"(inumpy\nndarray\n.",
        b"cnumpy\nndarray\n(I99999999999\ncnumpy\ndtype\n(S'O'\ntRtR.",
        b"Psomething\n.",
        b"\x80\x04\x95" + b"\xff" * 40,
        b"(" * 1000 + b".",
    ],
)
def test_broken_pickle_is_a_clear_error(tmp_path, content):
    path = tmp_path / "w.pkl"
    path.write_bytes(content)
    with pytest.raises(ModelFileError, match=r"w\.pkl: "):
        import_weights(path)


def test_endless_pickle(tmp_path):
    loop: dict = {}
    loop["a"] = loop["b"] = loop
    (tmp_path / "w.pkl").write_bytes(pickle.dumps(loop))
    with pytest.raises(ModelFileError, match="too deeply nested"):
        import_weights(tmp_path / "w.pkl")


def test_npy_with_objects_is_refused(tmp_path, fast):
    np.savez(tmp_path / "w.npz", **{**fast, "VoxelPoseNet/det1/biases": np.array([{}], object)})
    with pytest.raises(ModelFileError, match=r"w\.npz: not readable as numpy arrays"):
        import_weights(tmp_path / "w.npz")
    (tmp_path / "x.npz").write_bytes(b"PK nothing")
    with pytest.raises(ModelFileError, match=r"x\.npz"):
        import_weights(tmp_path / "x.npz")


def test_errors_name_file_variable_and_shapes(tmp_path, fast):
    path = tmp_path / "w.npz"

    def refused(weights, *words, variant=None):
        np.savez(path, **weights)
        with pytest.raises(ModelFileError) as e:
            import_weights(path, variant)
        for word in (str(path), *words):
            assert word in str(e.value)

    name = "VoxelPoseNet/det1/weights"
    transposed = fast[name].transpose(0, 1, 2, 4, 3)
    refused({**fast, name: transposed}, name, "[1, 1, 1, 256, 18]", "[1, 1, 1, 18, 256]")
    refused({n: a for n, a in fast.items() if n != name}, "missing", name)
    refused({**fast, "VoxelPoseNet/conv9/weights": np.zeros(3)}, "unexpected", "VoxelPoseNet/conv9/weights")
    refused({**fast, name: fast[name] * np.nan}, name, "NaN")
    refused({**fast, name: fast[name].astype(np.int8)}, name, "int8")
    refused(fast, "'paper'", "missing", "VoxelPoseNet/conv1_2/weights", variant="paper")
    with pytest.raises(UnderstudyError, match="variant 'slow'"):
        import_weights(path, "slow")
    with pytest.raises(ModelFileError, match="no such weights"):
        import_weights(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ModelFileError, match="holds neither"):
        import_weights(tmp_path / "empty")


def test_checkpoint_by_tensorflow(tmp_path, fast, monkeypatch):
    """With a stand-in for TensorFlow, which the tests do not install."""
    asked = []

    class Reader:
        def get_variable_to_shape_map(self):
            return {name: list(a.shape) for name, a in fast.items()} | {"VoxelPoseNet/det1/biases/Adam": [18]}

        def get_tensor(self, name):
            return fast.get(name, np.zeros(18, np.float32))

    def load_checkpoint(prefix):
        asked.append(prefix)
        return Reader()

    tensorflow = types.ModuleType("tensorflow")
    tensorflow.train = types.SimpleNamespace(load_checkpoint=load_checkpoint)
    monkeypatch.setitem(sys.modules, "tensorflow", tensorflow)
    for step in (9000, 10000):
        (tmp_path / f"model-{step}.index").touch()
    newest = tmp_path / "model-10000"
    for source in (tmp_path, newest, newest.with_name("model-10000.index"), newest.with_name("model-10000.meta")):
        assert_same(import_weights(source), fast)
    assert asked == [str(newest)] * 4

    monkeypatch.setitem(sys.modules, "tensorflow", None)
    with pytest.raises(ModelFileError, match="needs TensorFlow, which is not installed.*savez"):
        import_weights(newest)


# --- our files ---


def test_save_and_load(tmp_path, fast):
    pytest.importorskip("safetensors")
    path = tmp_path / "fast.safetensors"
    save_paper_weights(fast, path, {"source": "a formula"})
    weights, metadata = read_paper_weights(path)
    assert_same({name: weights[name] for name in fast}, fast)
    assert metadata["source"] == "a formula" and metadata["variant"] == "paper-fast"
    assert [p.name for p in tmp_path.iterdir()] == ["fast.safetensors"]
    pytest.importorskip("torch")
    from understudy.voxelposenet.paper_net import load_paper_net

    net = load_paper_net(path)
    assert net.variant == "paper-fast" and not net.training
    assert_same(net.variables(), fast)


def test_our_files_are_checked(tmp_path, fast):
    safetensors = pytest.importorskip("safetensors.numpy")
    path = tmp_path / "w.safetensors"
    with pytest.raises(ModelFileError, match="missing variables"):
        save_paper_weights({n: a for n, a in fast.items() if "det1" not in n}, path)
    assert not path.exists()
    with pytest.raises(ModelFileError, match="no such file"):
        read_paper_weights(path)
    path.write_bytes(b"nothing")
    with pytest.raises(ModelFileError, match=r"w\.safetensors: not readable"):
        read_paper_weights(path)
    safetensors.save_file({"a": np.zeros(3)}, path)
    with pytest.raises(ModelFileError, match="'format' must be 'understudy.paper_net/1'"):
        read_paper_weights(path)
    metadata = {"format": "understudy.paper_net/1", "variant": "none"}
    safetensors.save_file({"a": np.zeros(3)}, path, metadata)
    with pytest.raises(ModelFileError, match="'variant' is 'none': must be one of"):
        read_paper_weights(path)
    safetensors.save_file({"a": np.zeros(3)}, path, {**metadata, "variant": "paper"})
    with pytest.raises(ModelFileError, match=r"w\.safetensors.*missing variables"):
        read_paper_weights(path)


def test_reading_weights_needs_no_torch():
    code = "import sys, understudy.voxelposenet.tensorflow_weights, understudy.voxelposenet.paper_lifter\n"
    code += "assert not {'torch', 'tensorflow', 'safetensors'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
