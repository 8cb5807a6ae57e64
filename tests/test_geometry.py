import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from understudy.geometry import along, angle_between, inverse, is_rigid, plane_normal, rigid, transform_points

vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


@given(vectors, vectors, vectors)
def test_inverse_undoes(rotvec, t, p):
    T = rigid(Rotation.from_rotvec(rotvec).as_matrix(), t)
    assert is_rigid(T)
    np.testing.assert_allclose(transform_points(inverse(T), transform_points(T, p[None])), p[None], atol=1e-12)
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-12)


def test_mirrors_and_scales_are_not_rigid():
    assert not is_rigid(np.diag([-1.0, 1, 1, 1]))
    assert not is_rigid(np.diag([1.01, 1, 1, 1]))
    assert not is_rigid(np.full((4, 4), np.nan))


@given(vectors, st.floats(0, np.pi))
def test_angle_is_the_rotation_between(axis, angle):
    axis = axis + (0, 0, 4.0)
    across = np.cross(axis, (1.0, 0.3, 0))
    turned = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).apply(across)
    np.testing.assert_allclose(angle_between(across, turned), angle, atol=1e-7)


@given(st.integers(0, 2**32 - 1), st.sampled_from([(), (1,), (5,), (4, 7)]), st.integers(1, 6))
def test_along_is_the_dot_product_with_every_direction(seed, shape, k):
    rng = np.random.default_rng(seed)
    points, directions = rng.normal(size=(*shape, 3)), rng.normal(size=(k, 3))
    np.testing.assert_allclose(along(points, directions), points @ directions.T, atol=1e-12)
    assert along(points.astype(np.float32), directions.astype(np.float32)).dtype == np.float32


@given(st.integers(0, 2**32 - 1), st.integers(3, 40))
def test_plane_normal_is_that_of_the_singular_vectors(seed, n):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3)) * (2.0, 1.0, 0.05) @ Rotation.random(random_state=seed % 2**31).as_matrix() + 3
    normal = plane_normal(points)
    expected = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]
    np.testing.assert_allclose(normal * np.sign(normal @ expected), expected, atol=1e-5)
