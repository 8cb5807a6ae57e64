"""SO(3), SE(3), SE(2): laws, scipy as the oracle, finite differences, small angles and half turns."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from understudy import lie

ANGLES = (0.0, 1e-12, 1e-7, 1e-3, 0.1, 0.499, 0.501, 1.0, 2.5, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-12)


def _rotation_vectors(angles: tuple[float, ...] = ANGLES) -> np.ndarray:
    axes = np.random.default_rng(0).normal(size=(len(angles), 5, 3))
    axes[:, 0] = (0, 0, 1)
    axes[:, 1] = (1, 0, 0)
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    return axes * np.array(angles)[:, None, None]


def _twists(angles: tuple[float, ...] = ANGLES) -> np.ndarray:
    w = _rotation_vectors(angles)
    return np.concatenate([np.random.default_rng(1).normal(size=w.shape), w], axis=-1)


def _planar() -> np.ndarray:
    rng = np.random.default_rng(2)
    angles = np.array([*ANGLES[:-1], *(-a for a in ANGLES[:-1])])
    return np.stack([rng.normal(size=len(angles)), rng.normal(size=len(angles)), angles], axis=-1)


def _numeric(f: Callable[[np.ndarray], np.ndarray], size: int, step: float = 1e-6) -> np.ndarray:
    """Central differences of f (at zero) along each coordinate, as the last axis."""
    columns = [(f(step * unit) - f(-step * unit)) / (2 * step) for unit in np.eye(size)]
    return np.stack(columns, axis=-1)


def test_rotations_equal_scipys() -> None:
    w = _rotation_vectors()
    R = lie.so3_exp(w)
    np.testing.assert_allclose(R, Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(R.shape), atol=1e-15)
    np.testing.assert_allclose(lie.so3_log(R), w, atol=2e-12)
    any_R = Rotation.random(2000, rng=np.random.default_rng(3)).as_matrix()
    np.testing.assert_allclose(lie.so3_log(any_R), Rotation.from_matrix(any_R).as_rotvec(), atol=1e-12)


def test_half_turns_come_back() -> None:
    w = _rotation_vectors((np.pi,))
    np.testing.assert_allclose(lie.so3_exp(lie.so3_log(lie.so3_exp(w))), lie.so3_exp(w), atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(lie.so3_log(lie.so3_exp(w)), axis=-1), np.pi, atol=1e-14)


def test_exponentials_are_matrix_exponentials() -> None:
    for d in _twists().reshape(-1, 6):
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = lie.hat(d[3:]), d[:3]
        np.testing.assert_allclose(lie.se3_exp(d), expm(generator), atol=1e-13)
    for d in _planar():
        flat = np.array([d[0], d[1], 0, 0, 0, d[2]])
        np.testing.assert_allclose(lie.se2_to_se3(lie.se2_exp(d)), lie.se3_exp(flat), atol=1e-14)


def test_logarithms_undo_exponentials() -> None:
    np.testing.assert_allclose(lie.se3_log(lie.se3_exp(_twists())), _twists(), atol=1e-11)
    np.testing.assert_allclose(lie.se2_log(lie.se2_exp(_planar())), _planar(), atol=1e-11)


def test_small_twists_keep_their_digits() -> None:
    d = np.array([1e-9, -2e-9, 3e-9, 4e-10, 5e-10, -6e-10])
    np.testing.assert_allclose(lie.se3_log(lie.se3_exp(d)), d, rtol=1e-6)


def test_inverses_and_adjoints() -> None:
    d = _twists()
    T = lie.se3_exp(d)
    np.testing.assert_allclose(T @ lie.se3_inverse(T), np.broadcast_to(np.eye(4), T.shape), atol=1e-14)
    x = np.random.default_rng(4).normal(size=d.shape)
    left = lie.se3_exp((lie.se3_adjoint(T) @ x[..., None])[..., 0]) @ T
    np.testing.assert_allclose(T @ lie.se3_exp(x), left, atol=1e-12)
    a, y = lie.se2_exp(_planar()), np.random.default_rng(5).normal(size=_planar().shape)
    moved = lie.se2_compose(a, lie.se2_exp(y))
    by_adjoint = lie.se2_compose(lie.se2_exp((lie.se2_adjoint(a) @ y[..., None])[..., 0]), a)
    np.testing.assert_allclose(lie.se2_to_se3(moved), lie.se2_to_se3(by_adjoint), atol=1e-12)
    unit = lie.se2_compose(a, lie.se2_inverse(a))
    np.testing.assert_allclose(unit, np.zeros_like(unit), atol=1e-14)


@pytest.mark.parametrize("angles", [ANGLES[:9]], ids=["up to 2.5 rad"])
def test_jacobians_are_derivatives(angles: tuple[float, ...]) -> None:
    d = _twists(angles)
    T_inverse = lie.se3_inverse(lie.se3_exp(d))
    left = _numeric(lambda x: lie.se3_log(lie.se3_exp(d + x) @ T_inverse), 6)
    np.testing.assert_allclose(lie.se3_left_jacobian(d), left, atol=1e-8)
    right = _numeric(lambda x: lie.se3_log(T_inverse @ lie.se3_exp(d + x)), 6)
    np.testing.assert_allclose(lie.se3_left_jacobian(-d), right, atol=1e-8)
    p = _planar()
    p = p[np.abs(p[:, 2]) < 3]
    back = lie.se2_inverse(lie.se2_exp(p))
    flat = _numeric(lambda x: lie.se2_log(lie.se2_compose(lie.se2_exp(p + x), back)), 3)
    np.testing.assert_allclose(lie.se2_left_jacobian(p), flat, atol=1e-8)


def test_derivatives_of_the_logarithm() -> None:
    """What every edge of the graph rests on."""
    d = _twists(ANGLES[:9])
    A, T = np.eye(4), lie.se3_exp(d)
    by_T = _numeric(lambda x: lie.se3_log(T @ lie.se3_exp(x)), 6)
    np.testing.assert_allclose(lie.se3_left_jacobian_inverse(-d), by_T, atol=1e-7)
    by_A = _numeric(lambda x: lie.se3_log(lie.se3_inverse(A @ lie.se3_exp(x)) @ T), 6)
    np.testing.assert_allclose(-lie.se3_left_jacobian_inverse(d), by_A, atol=1e-7)


def test_inverse_jacobians_are_inverses() -> None:
    d = _twists()
    product = lie.se3_left_jacobian(d) @ lie.se3_left_jacobian_inverse(d)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(6), product.shape), atol=1e-11)
    p = _planar()
    flat = lie.se2_left_jacobian(p) @ lie.se2_left_jacobian_inverse(p)
    np.testing.assert_allclose(flat, np.broadcast_to(np.eye(3), flat.shape), atol=1e-11)
    w = _rotation_vectors()
    turn = lie.so3_left_jacobian(w) @ lie.so3_left_jacobian_inverse(w)
    np.testing.assert_allclose(turn, np.broadcast_to(np.eye(3), turn.shape), atol=1e-13)


def test_angles_are_wrapped() -> None:
    np.testing.assert_allclose(lie.wrapped(np.array([3 * np.pi, -3.5, 7.0])), [-np.pi, 2 * np.pi - 3.5, 7 - 2 * np.pi])
