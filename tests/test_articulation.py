"""Articulations: poses and positions, derivatives, fits of exact synthetic tracks, and 23 real doors and drawers."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from scipy.spatial.transform import Rotation

from understudy.errors import UnderstudyError
from understudy.geometry import angle_between, rigid
from understudy.objects.articulation import FIXED, KINDS, PRISMATIC, REVOLUTE, Articulation
from understudy.objects.fit import fit_articulation
from understudy.objects.motion import (
    Hypotheses,
    derivatives,
    measured,
    position_of,
    residuals,
    slope,
    solve_positions,
    stepped,
)

KITCHEN = SHARED / "sturm_articulation" / "kitchen"
DRAWERS = ("M2U00394", "M2U00395", "M2U00407", "M2U00408")
DOORS = (
    tuple(  # runs of one door, told by hinge side (axis up or down, camera's y) and by width: nobody wrote down which
        (side, tuple(f"M2U00{run}" for run in runs))
        for side, runs in (
            (-1, (390, 401, 414)),
            (-1, (412, 416)),
            (-1, (389, 396, 397, 403, 410)),
            (1, (391, 392, 404, 405, 413)),
            (1, (411, 415)),
            (1, (393, 406)),
        )
    )
)
SIGMA_M, SIGMA_RAD = 0.003, np.radians(1.0)


def random_articulation(kind: str, random: np.random.Generator) -> Articulation:
    """Somewhere in front of the camera; hinges of 0.3 to 0.9 m, the point on the axis nearest to the part's origin."""
    T_rest = rigid(Rotation.random(rng=random).as_matrix(), random.normal(0, 0.5, 3) + [0, 0, 2])
    a = random.normal(size=3)
    a /= np.linalg.norm(a)
    across = np.cross(a, random.normal(size=3))
    point = T_rest[:3, 3] + random.uniform(0.3, 0.9) * across / np.linalg.norm(across)
    return Articulation(kind, T_rest, a, point if kind == REVOLUTE else T_rest[:3, 3], (0.0, 0.0))


def opening(n: int, way: float) -> np.ndarray:
    """Rest, a smooth motion, rest."""
    s = np.clip(np.linspace(-0.2, 1.2, n), 0, 1)
    return way * (3 * s**2 - 2 * s**3)


def noisy(T: np.ndarray, random: np.random.Generator, m: float = SIGMA_M, rad: float = SIGMA_RAD) -> np.ndarray:
    T = T.copy()
    T[:, :3, 3] += random.normal(0, m, (len(T), 3))
    T[:, :3, :3] = Rotation.from_rotvec(random.normal(0, rad, (len(T), 3))).as_matrix() @ T[:, :3, :3]
    return T


def noise(n: int, m: float = SIGMA_M, rad: float = SIGMA_RAD) -> np.ndarray:
    return np.tile(np.diag([m**2] * 3 + [rad**2] * 3), (n, 1, 1))


def spoiled(T: np.ndarray, share: float, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A share of the poses anywhere at all; which."""
    bad = random.random(len(T)) < share
    bad[:3] = False
    T = T.copy()
    T[bad, :3, 3] += random.uniform(-0.5, 0.5, (bad.sum(), 3))
    T[bad, :3, :3] = Rotation.random(int(bad.sum()), rng=random).as_matrix()
    return T, bad


def true_way(kind: str) -> float:
    return {FIXED: 0.0, PRISMATIC: 0.35, REVOLUTE: 1.2}[kind]


def axis_distance(a: Articulation, b: Articulation) -> float:
    """Of a's point from b's axis, metres."""
    offset = a.point - b.point
    return float(np.linalg.norm(offset - b.direction * (offset @ b.direction)))


@pytest.mark.parametrize("kind", KINDS)
def test_position_inverts_pose(kind: str) -> None:
    random = np.random.default_rng(0)
    articulation = random_articulation(kind, random)
    q = np.zeros(50) if kind == FIXED else random.uniform(-3, 3, 50)
    T = articulation.pose(q)
    assert np.allclose(articulation.position(T), q, atol=1e-9)
    found, sigma = position_of(articulation, T, noise(50))
    assert np.allclose(found, q, atol=1e-6)
    assert (sigma == 0).all() if kind == FIXED else (sigma > 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_frames_and_files_round_trip(kind: str) -> None:
    random = np.random.default_rng(1)
    articulation = random_articulation(kind, random)
    T = rigid(Rotation.random(rng=random).as_matrix(), random.normal(size=3))
    q = random.uniform(-1, 1, 9)
    assert np.allclose(articulation.moved(T).pose(q), T @ articulation.pose(q), atol=1e-12)
    assert articulation.moved(T).radius_m == pytest.approx(articulation.radius_m)
    inside = articulation.in_part()
    assert np.allclose(inside.T_rest, np.eye(4), atol=1e-12)
    assert np.allclose(articulation.T_rest @ inside.pose(q), articulation.pose(q), atol=1e-12)
    back = Articulation.from_json(json.loads(json.dumps(articulation.to_json())), "file")
    assert np.array_equal(back.pose(q), articulation.pose(q)) and back.range == articulation.range


def test_files_with_errors_are_named() -> None:
    good = random_articulation(REVOLUTE, np.random.default_rng(2)).to_json()
    for change in ({"kind": "screw"}, {"direction": [1, 1, 0]}, {"range": [1]}, {"T_rest": [[1]]}, {"point": "x"}):
        with pytest.raises(UnderstudyError, match=r"^demo\.json|articulation"):
            Articulation.from_json(good | change, "demo.json")
    with pytest.raises(UnderstudyError, match=r"demo\.json: articulation has no 'point'"):
        Articulation.from_json({k: v for k, v in good.items() if k != "point"}, "demo.json")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rotations", [0.0, 0.5])
def test_derivatives_equal_finite_differences(kind: str, rotations: float) -> None:
    random = np.random.default_rng(3)
    articulation = random_articulation(kind, random)
    q = random.uniform(-1, 1, 7)
    m = measured(noisy(articulation.pose(q), random, 0.1, rotations), noise(7))
    at = Hypotheses.of(articulation)
    J, h = derivatives(at, q, residuals(at, q, m)), 1e-6
    for k in range(J.shape[2]):
        step = np.zeros(J.shape[2])
        step[k] = h
        ahead, behind = (residuals(stepped(at, s), q, m) for s in (step, -step))
        assert np.allclose((ahead - behind) / (2 * h), J[:, :, k], atol=2e-6)
    moved = (articulation.pose(q + h)[:, :3, 3] - articulation.pose(q - h)[:, :3, 3]) / (2 * h)
    assert np.allclose(moved, slope(at, q)[:, :3], atol=1e-6)


def test_positions_are_least_squares() -> None:
    """Of all q nearby, none explains a noisy pose better."""
    random = np.random.default_rng(4)
    articulation = random_articulation(REVOLUTE, random)
    m = measured(noisy(articulation.pose(random.uniform(-3, 3, 40)), random, 0.02, 0.1), noise(40))
    at = Hypotheses.of(articulation)

    def misfit(q: np.ndarray) -> np.ndarray:
        return np.einsum("nij,nj->ni", m.whitener, residuals(at, q, m)).__pow__(2).sum(axis=1)

    best = solve_positions(at, m)
    for step in (-0.5, -1e-3, 1e-3, 0.5):
        assert (misfit(best + step) > misfit(best)).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("with_covariance", [True, False])
def test_bic_finds_the_kind_at_the_stated_noise(kind: str, with_covariance: bool) -> None:
    """3 mm, 1 degree, 60 poses: never wrong in 10 tracks; and the errors are as large as they are said to be."""
    scores = []
    for seed in range(10):
        random = np.random.default_rng(seed)
        truth = random_articulation(kind, random)
        T = noisy(truth.pose(opening(60, true_way(kind))), random)
        fit = fit_articulation(T, noise(60) if with_covariance else None)
        assert fit.articulation.kind == kind, (seed, fit.bic)
        if kind != FIXED:
            scores.append(angle_between(fit.articulation.direction, truth.direction) / fit.errors.direction_rad)
            assert np.degrees(scores[-1] * fit.errors.direction_rad) < 2
            assert fit.articulation.range[0] > -0.02 and fit.articulation.range[1] == pytest.approx(
                true_way(kind), abs=0.05
            )
    if kind != FIXED and with_covariance:
        assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.5


@pytest.mark.parametrize("kind", KINDS)
def test_outliers_and_missing_samples(kind: str) -> None:
    for seed in range(2):
        random = np.random.default_rng(100 + seed)
        truth = random_articulation(kind, random)
        T, bad = spoiled(noisy(truth.pose(opening(120, true_way(kind))), random), 0.3, random)
        gone = random.random(120) < 0.2
        T[gone] = np.nan
        fit = fit_articulation(T, noise(120))
        assert fit.articulation.kind == kind
        assert not fit.inlier[bad | gone].any() and fit.inlier[~bad & ~gone].mean() > 0.95
        assert np.isnan(fit.q[gone]).all() and np.isfinite(fit.q[~gone]).all()
        assert np.linalg.norm(fit.articulation.T_rest[:3, 3] - truth.T_rest[:3, 3]) < 0.008
        if kind != FIXED:
            assert np.degrees(angle_between(fit.articulation.direction, truth.direction)) < 1.5
        if kind == REVOLUTE:
            assert abs(fit.articulation.radius_m - truth.radius_m) < 0.01
            assert axis_distance(fit.articulation, truth) < 0.01


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", ["infinite", "nan"])
def test_positions_alone(kind: str, how: str) -> None:
    for seed in range(2):
        random = np.random.default_rng(200 + seed)
        truth = random_articulation(kind, random)
        T = noisy(truth.pose(opening(80, true_way(kind))), random)
        covariance = noise(80)
        if how == "nan":
            T[:, :3, :3] = np.nan
        else:
            covariance[:, range(3, 6), range(3, 6)] = np.inf
            T[:, :3, :3] = Rotation.random(80, rng=random).as_matrix()  # must not matter
        fit = fit_articulation(T, covariance)
        assert fit.articulation.kind == kind and np.isnan(fit.rms_rad)
        if kind != FIXED:
            assert np.degrees(angle_between(fit.articulation.direction, truth.direction)) < 4
        if kind == REVOLUTE:
            assert fit.articulation.radius_m == pytest.approx(truth.radius_m, rel=0.04)


def test_some_rotations_missing() -> None:
    random = np.random.default_rng(5)
    truth = random_articulation(REVOLUTE, random)
    T = noisy(truth.pose(opening(80, 1.0)), random)
    T[::2, :3, :3] = np.nan
    fit = fit_articulation(T, noise(80))
    assert fit.articulation.kind == REVOLUTE
    assert np.degrees(angle_between(fit.articulation.direction, truth.direction)) < 1


def test_exact_tracks_give_exact_articulations() -> None:
    for kind in KINDS:
        truth = random_articulation(kind, np.random.default_rng(6))
        q = opening(40, true_way(kind))
        fit = fit_articulation(truth.pose(q))
        assert fit.articulation.kind == kind
        assert np.allclose(fit.q, q, atol=1e-6) and fit.rms_m < 1e-6
        assert np.allclose(fit.articulation.pose(q), truth.pose(q), atol=1e-6)
        assert np.allclose(fit.articulation.point, truth.point, atol=1e-5)


def test_opening_is_positive_whichever_way_it_turns() -> None:
    for sign in (-1, 1):
        truth = random_articulation(REVOLUTE, np.random.default_rng(7))
        fit = fit_articulation(truth.pose(sign * opening(40, 1.0)))
        assert np.allclose(fit.articulation.direction, sign * truth.direction, atol=1e-6)
        assert fit.q[-1] == pytest.approx(1.0)


def test_drawers_do_not_become_wide_hinges() -> None:
    """From positions alone, with noise that is larger than stated and drifts."""
    for seed in range(6):
        random = np.random.default_rng(300 + seed)
        truth = random_articulation(PRISMATIC, random)
        T = noisy(truth.pose(opening(100, 0.3)), random)
        T[:, :3, 3] += 0.001 * np.cumsum(random.normal(size=(100, 3)), axis=0) / 3
        T[:, :3, :3] = np.nan
        assert fit_articulation(T, noise(100, 0.001)).articulation.kind == PRISMATIC


def test_what_hardly_moves_is_fixed() -> None:
    random = np.random.default_rng(8)
    truth = random_articulation(PRISMATIC, random)
    T = noisy(truth.pose(opening(60, 0.004)), random, 0.0005, 0.002)
    assert fit_articulation(T).articulation.kind == FIXED


@pytest.mark.parametrize("kind", [PRISMATIC, REVOLUTE])
def test_short_motions(kind: str) -> None:
    """4 cm of a drawer, 6 degrees of a hinge at 3 mm and 1 degree of noise: the right kind in 5 of 6 or more."""
    right = 0
    for seed in range(6):
        random = np.random.default_rng(400 + seed)
        truth = random_articulation(kind, random)
        T = noisy(truth.pose(opening(80, 0.04 if kind == PRISMATIC else np.radians(6))), random)
        right += fit_articulation(T, noise(80)).articulation.kind == kind
    assert right >= 5


def test_one_kind_can_be_asked_for() -> None:
    truth = random_articulation(REVOLUTE, np.random.default_rng(9))
    fit = fit_articulation(truth.pose(opening(30, 0.5)), kinds=(PRISMATIC,))
    assert fit.articulation.kind == PRISMATIC and set(fit.bic) == {PRISMATIC}


def test_bad_input() -> None:
    T = np.tile(np.eye(4), (9, 1, 1))
    with pytest.raises(UnderstudyError, match="'fixed', 'prismatic', 'revolute'"):
        fit_articulation(T, kinds=("screw",))
    with pytest.raises(UnderstudyError, match="5 poses or more, got 4"):
        fit_articulation(np.concatenate([T[:4], np.full((3, 4, 4), np.nan)]))
    with pytest.raises(UnderstudyError, match="positive definite"):
        fit_articulation(T, np.zeros((9, 6, 6)))
    with pytest.raises(UnderstudyError, match="finite"):
        fit_articulation(T, np.full((9, 6, 6), np.nan))


@cache
def kitchen_tracks() -> dict[str, np.ndarray]:
    if not KITCHEN.is_dir():
        pytest.skip(f"the real tracks {KITCHEN} are not on this machine")
    tracks = {}
    for path in sorted(Path(KITCHEN).glob("*.log")):
        rows = np.loadtxt(path)
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        T[:, :3, 3], T[:, :3, :3] = rows[:, :3], Rotation.from_quat(rows[:, 3:]).as_matrix()
        tracks[path.stem] = T
    return tracks


def test_real_doors_and_drawers_are_told_apart_and_repeat() -> None:
    """All 23 kinds right; in runs of one door, radii within 3 % of their mean."""
    tracks = kitchen_tracks()
    assert len(tracks) == 23
    fits = {name: fit_articulation(T[::3]) for name, T in tracks.items()}  # to save time
    kinds = {name: fit.articulation.kind for name, fit in fits.items()}
    assert kinds == {name: PRISMATIC if name in DRAWERS else REVOLUTE for name in tracks}
    assert {run for _, runs in DOORS for run in runs} == {name for name in tracks if name not in DRAWERS}
    for side, runs in DOORS:
        doors = [fits[run].articulation for run in runs]
        assert [np.sign(door.direction[1]) for door in doors] == [side] * len(runs)
        radii = np.array([door.radius_m for door in doors])
        assert np.abs(radii / radii.mean() - 1).max() < 0.03, (runs, radii)


def test_halves_of_real_runs_agree() -> None:
    """Odd and even poses of each of the 23 runs: radii within 3 %, directions within 1.7 degrees (3 % of a radian)."""
    for name, T in kitchen_tracks().items():
        kind = PRISMATIC if name in DRAWERS else REVOLUTE
        odd, even = (fit_articulation(T[k::2], kinds=(kind,)).articulation for k in (1, 0))
        assert np.degrees(angle_between(odd.direction, even.direction)) < 1.7, name
        if name not in DRAWERS:
            assert abs(odd.radius_m / even.radius_m - 1) < 0.03, name
