"""What users pay for: import and help stay light."""

import subprocess
import sys
from importlib.metadata import requires

HEAVY = ("torch", "tensorflow", "mediapipe", "open3d", "rclpy", "rospy", "mujoco", "viser", "matplotlib", "av", "bpy")


def modules_after(code: str) -> set[str]:
    program = f"import sys\n{code}\nprint('\\n'.join(sys.modules))"
    return set(
        subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout.split()
    )


def test_import_and_help_load_next_to_nothing():
    assert not {"numpy", "cv2", "scipy", *HEAVY} & modules_after("import understudy")
    code = "import contextlib, io\nfrom understudy.cli import main\n"
    code += "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()): main(['--help'])"
    assert not {"numpy", "cv2", "scipy", *HEAVY} & modules_after(code)


def test_inference_loads_nothing_heavy():
    code = "from understudy import Estimator, recordings\nimport understudy.pipeline, understudy.detectors.blazepose"
    assert not set(HEAVY) & modules_after(code)


def test_public_names_are_there():
    import understudy

    for name in understudy.__all__:
        assert getattr(understudy, name) is not None
    assert set(understudy.__all__) == set(dir(understudy))


def test_base_install_is_light():
    """Heavy packages stand behind extras."""
    base = [r for r in requires("understudy") or [] if "extra ==" not in r]
    assert base
    assert not [r for r in base if r.lower().startswith(HEAVY)]
