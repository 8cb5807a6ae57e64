"""The networks' runtime: its answers, its errors, and that it keeps to itself."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from understudy import assets, recordings, runtime
from understudy.errors import ModelFileError, UnderstudyError
from understudy.registration import register
from understudy.runtime import Network, load

CHANNELS, SIZE = 48, 12
KERNELS = np.random.default_rng(0).normal(size=(CHANNELS, CHANNELS, 3, 3, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def ir(tmp_path_factory) -> Path:
    """A network in OpenVINO's own format, in a folder with an awkward name: a 3D convolution, and a sum."""
    ov, _ = runtime._openvino()
    ops = ov.opset13
    volume = ops.parameter([1, CHANNELS, SIZE, SIZE, SIZE], np.float32, name="volume")
    scale = ops.parameter([1], np.float32, name="scale")
    convolved = ops.convolution(volume, ops.constant(KERNELS), [1] * 3, [1] * 3, [1] * 3, [1] * 3)
    outputs = [ops.multiply(convolved, scale), ops.reduce_sum(volume, [0, 1, 2, 3, 4])]
    for node, name in zip([volume, scale, *outputs], ["volume", "scale", "convolved", "sum"], strict=True):
        node.output(0).set_names({name})
    path = tmp_path_factory.mktemp("Stühle und Türen") / "net.xml"
    ov.save_model(ov.Model(outputs, [volume, scale]), path, compress_to_fp16=False)
    return path


@pytest.fixture(scope="module")
def network(ir: Path) -> Network:
    return load(ir, threads=2)


def volume(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(1, CHANNELS, SIZE, SIZE, SIZE)).astype(np.float32)


ONE, TWO = np.ones(1, np.float32), np.full(1, 2, np.float32)


def test_convolution_in_three_dimensions_in_full_precision(network):
    x = volume(1)
    y, total = network(x, TWO)
    exact = [sum(signal.correlate(c, k, "same") for c, k in zip(x[0].astype(float), ks, strict=True)) for ks in KERNELS]
    assert y.dtype == np.float32
    np.testing.assert_allclose(y[0], 2 * np.array(exact), atol=1e-5 * np.abs(exact).max())  # bfloat16: 4e-3
    np.testing.assert_allclose(total, x.sum(dtype=float), atol=1e-3)


def test_inputs_by_place_or_name_each_once(network):
    assert network.inputs == ("volume", "scale") and network.outputs == ("convolved", "sum")
    x = volume(2)
    by_place = network(x, ONE)
    np.testing.assert_array_equal(network(scale=ONE, volume=x)[0], by_place[0])
    np.testing.assert_array_equal(network(x, scale=ONE)[0], by_place[0])
    np.testing.assert_array_equal(network(x[:, ::-1], ONE)[0], network(x[:, ::-1].copy(), ONE)[0])  # strided
    for places, names in (((), {}), ((x,), {}), ((x, ONE, ONE), {}), ((x, ONE), {"scale": ONE}), ((x,), {"size": ONE})):
        with pytest.raises(TypeError, match=r"each of \('volume', 'scale'\) once"):
            network(*places, **names)


def test_chosen_outputs_in_the_chosen_order(ir, network):
    x = volume(3)
    np.testing.assert_array_equal(load(ir, outputs=["sum"])(x, ONE)[0], network(x, ONE)[1])
    swapped = load(ir, threads=2, outputs=["sum", "convolved"])
    assert swapped.outputs == ("sum", "convolved")
    np.testing.assert_array_equal(swapped(x, ONE)[1], network(x, ONE)[0])
    with pytest.raises(ModelFileError, match=r"no output 'mean'; it has one of 'convolved', 'sum'"):
        load(ir, outputs=["mean"])


def test_results_are_the_callers(network):
    first = network(volume(4), ONE)[0]
    copy = first.copy()
    network(volume(5), ONE)
    np.testing.assert_array_equal(first, copy)
    first[:] = 0
    np.testing.assert_array_equal(network(volume(4), ONE)[0], copy)


@pytest.mark.parametrize("streams", [1, 2])
def test_many_threads_get_the_same_bits(ir, streams):
    network = load(ir, threads=2, streams=streams)
    inputs = [volume(seed) for seed in range(6)]
    alone = [network(x, ONE)[0] for x in inputs]
    with ThreadPoolExecutor(8) as pool:
        together = pool.map(lambda i: (i, network(inputs[i], ONE)[0]), list(range(6)) * 20)
        assert all((alone[i] == y).all() for i, y in together)


@pytest.fixture(scope="module")
def open_rows(tmp_path_factory) -> Path:
    """A network for any number of rows: each volume convolved, times a number of its own."""
    ov, _ = runtime._openvino()
    ops = ov.opset13
    volumes = ops.parameter([-1, CHANNELS, SIZE, SIZE, SIZE], np.float32, name="volume")
    scale = ops.parameter([-1, 1, 1, 1, 1], np.float32, name="scale")
    product = ops.multiply(ops.convolution(volumes, ops.constant(KERNELS), [1] * 3, [1] * 3, [1] * 3, [1] * 3), scale)
    outputs = [product, ops.reduce_sum(volumes, [1, 2, 3, 4])]
    for node, name in zip([volumes, scale, *outputs], ["volume", "scale", "convolved", "sum"], strict=True):
        node.output(0).set_names({name})
    path = tmp_path_factory.mktemp("rows") / "rows.xml"
    ov.save_model(ov.Model(outputs, [volumes, scale]), path, compress_to_fp16=False)
    return path


@pytest.mark.parametrize("limit", ["1", "2", ""])
@pytest.mark.parametrize("same_bits", [False, True])
def test_rows_are_computed_each_on_its_own(open_rows, monkeypatch, limit, same_bits):
    monkeypatch.setenv(runtime.THREADS, limit)
    whole, by_row = load(open_rows), runtime.load_rows(open_rows, same_bits=same_bits)
    assert [shape[0] for shape in whole.shapes.values()] == [-1, -1]
    assert by_row.shapes == {"volume": (1, CHANNELS, SIZE, SIZE, SIZE), "scale": (1, 1, 1, 1, 1)}
    assert (by_row.inputs, by_row.outputs) == (whole.inputs, whole.outputs) == (("volume", "scale"), whole.outputs)
    x = np.concatenate([volume(seed) for seed in range(7)])
    scale = np.arange(1, 8, dtype=np.float32).reshape(7, 1, 1, 1, 1)
    for n in (1, 2, 3, 7):
        given = {"volume": x[:n], "scale": scale[:n]}
        for got, expected in zip(by_row(**given), whole(**given), strict=True):
            assert got.shape == expected.shape
            np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-4 * np.abs(expected).max())
    two, seven = by_row(volume=x[:2], scale=scale[:2]), by_row(volume=x, scale=scale)
    for got, expected in zip(two, seven, strict=True):
        np.testing.assert_array_equal(got, expected[:2])


def test_rows_in_many_threads(open_rows):
    network = runtime.load_rows(open_rows)
    one = np.ones((1, 1, 1, 1, 1), np.float32)
    inputs = [(np.repeat(volume(seed), n, axis=0), np.repeat(one, n, axis=0)) for seed, n in enumerate((1, 2, 3, 4))]
    alone = [network(volume=v, scale=s)[0] for v, s in inputs]
    with ThreadPoolExecutor(6) as pool:
        chosen = [0, 1, 2, 3] * 10
        together = pool.map(lambda i: network(volume=inputs[i][0], scale=inputs[i][1])[0], chosen)
        for i, y in zip(chosen, together, strict=True):
            np.testing.assert_array_equal(y, alone[i])


def test_rows_must_be_as_many_in_every_input(open_rows):
    network = runtime.load_rows(open_rows)
    ones = np.ones((2, 1, 1, 1, 1), np.float32)
    for given in (
        {"volume": volume(0)},
        {"volume": volume(0), "scale": ones},
        {"volume": volume(0)[:0], "scale": ones[:0]},
    ):
        with pytest.raises(TypeError, match=r"the network takes \('volume', 'scale'\), each with as many rows"):
            network(**given)


def test_threads_can_be_limited_from_outside(ir, network, monkeypatch):
    available = runtime.processors()
    monkeypatch.setenv(runtime.THREADS, "1")
    limited = load(ir, threads=2, streams=2)
    config = limited._compiled.get_property
    assert runtime.processors() == 1 and config("INFERENCE_NUM_THREADS") == config("NUM_STREAMS") == 1
    np.testing.assert_array_equal(limited(volume(6), ONE)[0], network(volume(6), ONE)[0])
    monkeypatch.setenv(runtime.THREADS, "1000")
    assert runtime.processors() == available
    for word in ("0", "two", "-1"):
        monkeypatch.setenv(runtime.THREADS, word)
        with pytest.raises(UnderstudyError, match=f"UNDERSTUDY_THREADS.*{word}"):
            load(ir)


def test_first_calls_at_the_same_time_do_not_block_each_other(tmp_path):
    """OpenVINO's own first calls do, once in 30 processes: in none of these may it happen."""
    (tmp_path / "net.onnx").write_bytes(onnx_file())
    code = f"""if True:
        import sys, threading
        import numpy as np
        from pathlib import Path
        from understudy.runtime import load
        sys.setswitchinterval(1e-6)
        network, start = load(Path({str(tmp_path / "net.onnx")!r}), threads=2, streams=2), threading.Barrier(8)
        def work():
            start.wait()
            network(np.zeros(3, np.float32))
        threads = [threading.Thread(target=work) for _ in range(8)]
        for t in threads: t.start()
        for t in threads: t.join()
    """
    for _ in range(3):
        subprocess.run([sys.executable, "-c", code], check=True, timeout=50)


def test_a_call_that_failed_leaves_no_trace(network):
    expected = network(volume(6), ONE)[0]
    with pytest.raises(RuntimeError):
        network(volume(6)[:, :, :5], ONE)
    np.testing.assert_array_equal(network(volume(6), ONE)[0], expected)


def onnx_file() -> bytes:
    """y = relu(x), three numbers, in protobuf's wire format."""

    def field(number: int, content: bytes | int) -> bytes:
        if isinstance(content, int):
            return bytes([number << 3, content])
        return bytes([number << 3 | 2, len(content)]) + content

    def value(name: bytes) -> bytes:
        shape = field(1, field(1, 3))  # one dimension of 3
        return field(1, name) + field(2, field(1, field(1, 1) + field(2, shape)))  # element type 1: float

    node = field(1, b"x") + field(2, b"y") + field(4, b"Relu")
    graph = field(1, node) + field(2, b"g") + field(11, value(b"x")) + field(12, value(b"y"))
    return field(1, 8) + field(7, graph) + field(8, field(2, 13))


def test_onnx(tmp_path):
    path = tmp_path / "net.onnx"
    path.write_bytes(onnx_file())
    (y,) = load(path)(np.array([-1, 0, 2], np.float32))
    np.testing.assert_array_equal(y, [0, 0, 2])


@pytest.mark.parametrize("kind", runtime.KINDS)
@pytest.mark.parametrize("content", [b"", b"not a network", bytes(range(256)) * 40])
def test_damaged_files(tmp_path, kind, content):
    path = tmp_path / f"net{kind}"
    path.write_bytes(content)
    with pytest.raises(ModelFileError, match=rf"net\{kind}: damaged, or not a network"):
        load(path)


def test_truncated_files(tmp_path, ir, models):
    (tmp_path / "net.xml").write_bytes(ir.read_bytes())
    for weights in (None, ir.with_suffix(".bin").read_bytes()[:1000]):
        if weights is not None:
            (tmp_path / "net.bin").write_bytes(weights)
        with pytest.raises(ModelFileError, match=r"net\.xml: damaged, .* bin file"):
            load(tmp_path / "net.xml")
    whole = assets.model_path("pose_detection").read_bytes()
    (tmp_path / "net.tflite").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ModelFileError, match=r"net\.tflite: damaged"):
        load(tmp_path / "net.tflite")


def test_absent_files_and_other_kinds(tmp_path):
    with pytest.raises(ModelFileError, match=r"net\.onnx: there is no such file"):
        load(tmp_path / "net.onnx")
    with pytest.raises(ModelFileError, match=r"net\.pt: .* must end in one of '\.tflite', '\.onnx', '\.xml'"):
        load(tmp_path / "net.pt")


def test_import_is_late():
    code = "import sys, understudy.runtime, understudy.detectors.blazepose, understudy.pipeline\n"
    code += "assert not {m for m in sys.modules if m.startswith('openvino')}"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_nothing_is_sent_and_nothing_written(tmp_path, ir):
    """Importing OpenVINO alone would send an event (from a child process) and put an id into the user's home."""
    code = f"""if True:
        import multiprocessing, os, socket, sys
        from pathlib import Path
        def sent(*args, **kwargs):
            with open({str(tmp_path / "sent")!r}, "a") as f:
                f.write(repr(args))
            raise OSError("not in this test")
        socket.getaddrinfo = socket.socket.connect = socket.socket.connect_ex = socket.socket.sendto = sent
        os.fork = os.posix_spawn = multiprocessing.Process.start = sent
        import numpy as np
        from understudy.runtime import load
        network = load(Path({str(ir)!r}))
        network(np.zeros((1, {CHANNELS}, {SIZE}, {SIZE}, {SIZE}), np.float32), np.ones(1, np.float32))
        from openvino import convert_model  # what else might send, later on
        convert_model({str(ir.parent / "relu.onnx")!r})
        assert not hasattr(sys.modules["openvino_telemetry"], "Telemetry")
    """
    (ir.parent / "relu.onnx").write_bytes(onnx_file())
    home, work = tmp_path / "home", tmp_path / "work"
    home.mkdir()
    work.mkdir()
    environment = {
        k: v for k, v in os.environ.items() if k not in ("CI", "TF_BUILD", "JENKINS_URL")
    }  # these silence it
    environment |= {"HOME": str(home), "XDG_CACHE_HOME": str(home / "cache"), "TMPDIR": str(work)}
    out = subprocess.run([sys.executable, "-c", code], env=environment, cwd=work, capture_output=True, text=True)
    assert (out.returncode, out.stdout, out.stderr) == (0, "", "")
    assert not (tmp_path / "sent").exists()
    assert not list(home.iterdir()) and not list(work.iterdir())
    assert sorted(p.name for p in ir.parent.iterdir()) == ["net.bin", "net.xml", "relu.onnx"]


# --- BlazePose, against the reference implementation of its file format ---


@pytest.mark.parametrize("name", ["pose_detection", "pose_landmark_full"])
def test_blazepose_as_litert_computes_it(models, monkeypatch, name):
    """Every crop of a frame with several people, through both."""
    litert = pytest.importorskip("ai_edge_litert.interpreter", reason="the oracle ai-edge-litert is not installed")
    from understudy.detectors.blazepose import BlazePoseDetector

    calls = []

    def record(self: Network, image: np.ndarray) -> tuple[np.ndarray, ...]:
        calls.append((image, self.outputs, original(self, image)))
        return calls[-1][-1]

    original = Network.__call__
    monkeypatch.setattr(Network, "__call__", record)
    frame = register(recordings.open("sample")[0])
    assert len(BlazePoseDetector().detect(frame.color, frame.depth)) == 2

    interpreter = litert.Interpreter(str(assets.model_path(name)), num_threads=1)
    interpreter.allocate_tensors()
    source, sinks = interpreter.get_input_details()[0], interpreter.get_output_details()
    calls = [c for c in calls if c[0].shape == tuple(source["shape"])]
    assert len(calls) >= 5
    for image, names, ours in calls:
        interpreter.set_tensor(source["index"], image)
        interpreter.invoke()
        theirs = {sink["name"]: interpreter.get_tensor(sink["index"]) for sink in sinks}
        for output, mine in zip(names, ours, strict=True):
            assert mine.shape == theirs[output].shape
            np.testing.assert_allclose(mine, theirs[output], atol=0.02)  # pixels of the crop, or logits
