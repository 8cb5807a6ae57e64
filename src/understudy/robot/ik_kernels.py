"""Damped Gauss-Newton with bounds, compiled: the inner loop of `ik` and of the training of `reachability`.

All joints, the torso's height first, are bounded by `lower` and `upper` (infinite for continuous ones; equal for one
that must not move). The residual is (translation, L times rotation vector) in the tool's frame, L in metres per radian.
"""

from __future__ import annotations

import numpy as np

from understudy.robot.chain import compiled, frames, jacobian, pose_error


@compiled
def _copy(source, out):  # type: ignore[no-untyped-def]
    """out = source, vectors. Array expressions would do the same, but take ten times as long to compile."""
    for i in range(source.shape[0]):
        out[i] = source[i]


@compiled
def _cholesky_solve(A, b):  # type: ignore[no-untyped-def]
    """b <- A^-1 b for a small positive definite A, which is overwritten."""
    n = A.shape[0]
    for j in range(n):
        for k in range(j):
            A[j, j] -= A[j, k] * A[j, k]
        A[j, j] = np.sqrt(A[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] /= A[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]


@compiled
def _weighted(J, e, L):  # type: ignore[no-untyped-def]
    """Scales the rotation's rows by L; returns half the squared residual."""
    cost = 0.0
    for i in range(6):
        if i >= 3:
            e[i] *= L
            for j in range(J.shape[1]):
                J[i, j] *= L
        cost += 0.5 * e[i] * e[i]
    return cost


@compiled
def _free_columns(J, e, q, lower, upper):  # type: ignore[no-untyped-def]
    """Zeroes the columns of joints that sit at a bound and would leave through it."""
    for j in range(q.shape[0]):
        g = 0.0
        for i in range(6):
            g += J[i, j] * e[i]
        if (q[j] <= lower[j] and g <= 0) or (q[j] >= upper[j] and g >= 0):
            for i in range(6):
                J[i, j] = 0.0


@compiled
def _damped_step(J, e, damping, A, y, step):  # type: ignore[no-untyped-def]
    """step = J^T (J J^T + damping)^-1 e."""
    n = J.shape[1]
    for i in range(6):
        y[i] = e[i]
        for k in range(i + 1):
            s = 0.0
            for j in range(n):
                s += J[i, j] * J[k, j]
            A[i, k] = s
        A[i, i] += damping
    _cholesky_solve(A, y)
    for j in range(n):
        step[j] = 0.0
        for i in range(6):
            step[j] += J[i, j] * y[i]


@compiled
def descend(fixed, q, lower, upper, target, L, iterations):  # type: ignore[no-untyped-def]
    """Moves q (in place) to where the tool is nearest to the target (3, 4). Returns (metres, radians) that are left."""
    n = q.shape[0]
    work, tmp, J, e = np.empty((n + 1, 3, 4)), np.empty((3, 4)), np.empty((6, n)), np.empty(6)
    A, y, step, trial, e2 = np.empty((6, 6)), np.empty(6), np.empty(n), np.empty(n), np.empty(6)
    damping = 1e-4
    frames(fixed, q, work, tmp)
    pose_error(work[n], target, e)
    jacobian(work, J)
    cost = _weighted(J, e, L)
    slow = 0
    for _ in range(iterations):
        if cost < 1e-14:
            break
        _free_columns(J, e, q, lower, upper)
        _damped_step(J, e, damping, A, y, step)
        for j in range(n):
            trial[j] = min(max(q[j] + min(max(step[j], -0.7), 0.7), lower[j]), upper[j])
        frames(fixed, trial, work, tmp)
        pose_error(work[n], target, e2)
        after = 0.0
        for i in range(6):
            after += 0.5 * e2[i] * e2[i] * (1.0 if i < 3 else L * L)
        if after < cost:
            slow = slow + 1 if after > 0.98 * cost else 0
            _copy(trial, q)
            damping = max(damping * 0.2, 1e-9)
            _copy(e2, e)
            jacobian(work, J)
            cost = _weighted(J, e, L)
            if slow >= 6:
                break
        else:
            damping *= 8.0
            if damping > 1e3:
                break
            # J has lost columns of joints at their bounds, which is right for this q still
    return np.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2), np.sqrt(e[3] ** 2 + e[4] ** 2 + e[5] ** 2) / L


@compiled
def posture_cost(q, reference, scale):  # type: ignore[no-untyped-def]
    """Mean squared distance of the arm's joints from a reference, in units of `scale`."""
    s = 0.0
    for j in range(1, q.shape[0]):
        s += ((q[j] - reference[j]) / scale[j]) ** 2
    return s / (q.shape[0] - 1)


@compiled
def relax(fixed, q, lower, upper, target, L, reference, scale, rounds):  # type: ignore[no-untyped-def]
    """Slides an exact solution q (in place) along its self-motion towards the reference posture; stays exact."""
    n = q.shape[0]
    work, tmp, J = np.empty((n + 1, 3, 4)), np.empty((3, 4)), np.empty((6, n))
    A, y, pull, back, b = np.empty((6, 6)), np.empty(6), np.empty(n), np.empty(n), np.empty(6)
    best, trial = posture_cost(q, reference, scale), np.empty(n)
    gain = 0.5
    for _ in range(rounds):
        frames(fixed, q, work, tmp)
        jacobian(work, J)
        for j in range(n):
            pull[j] = (reference[j] - q[j]) if j > 0 else 0.0
            if (q[j] <= lower[j] and pull[j] <= 0) or (q[j] >= upper[j] and pull[j] >= 0) or lower[j] == upper[j]:
                pull[j] = 0.0
                for i in range(6):
                    J[i, j] = 0.0
        for i in range(6):
            b[i] = 0.0
            for j in range(n):
                b[i] += J[i, j] * pull[j]
        _damped_step(J, b, 1e-6, A, y, back)
        for j in range(n):
            trial[j] = min(max(q[j] + gain * (pull[j] - back[j]), lower[j]), upper[j])
        position, angle = descend(fixed, trial, lower, upper, target, L, 8)
        cost = posture_cost(trial, reference, scale)
        if position < 1e-6 and angle < 1e-5 and cost < best:
            if cost > 0.99 * best:
                break
            _copy(trial, q)
            best = cost
        else:
            gain *= 0.4
            if gain < 0.05:
                break


@compiled
def near_reference(q, reference, continuous):  # type: ignore[no-untyped-def]
    """Turns continuous joints (in place) by whole turns to within half a turn of the reference."""
    for j in range(1, q.shape[0]):
        if continuous[j]:
            q[j] -= 2 * np.pi * np.round((q[j] - reference[j]) / (2 * np.pi))


@compiled
def solve_from_seeds(  # type: ignore[no-untyped-def]
    fixed, seeds, lower, upper, continuous, targets, L, reference, scale, limits, wanted, rounds
):
    """Exact solutions for m targets (m, 3, 4) from seeds (m, k, n), in order, until `wanted` are found for each.

    lower, upper, reference (m, n). limits: largest (metres, radians) of a solution. Returns the solutions
    (m, wanted, n) with the smallest posture cost first, their cost (inf: none), and the smallest residual's
    (configuration, metres, radians) over all seeds, for targets without solution.
    """
    m, k, n = seeds.shape
    solutions, costs = np.zeros((m, wanted, n)), np.full((m, wanted), np.inf)
    nearest, left = np.zeros((m, n)), np.zeros((m, 2))
    q = np.empty(n)
    for i in range(m):
        found, least = 0, np.inf
        for s in range(k):
            for j in range(n):
                q[j] = min(max(seeds[i, s, j], lower[i, j]), upper[i, j])
            position, angle = descend(fixed, q, lower[i], upper[i], targets[i], L, 60)
            residual = position**2 + (L * angle) ** 2
            if residual < least:
                least = residual
                _copy(q, nearest[i])
                left[i, 0], left[i, 1] = position, angle
            if position > limits[0] or angle > limits[1]:
                continue
            near_reference(q, reference[i], continuous)
            if rounds > 0:
                relax(fixed, q, lower[i], upper[i], targets[i], L, reference[i], scale, rounds)
            cost = posture_cost(q, reference[i], scale)
            new = True
            for o in range(found):
                apart = 0.0
                for j in range(n):
                    apart = max(apart, abs(solutions[i, o, j] - q[j]))
                new = new and apart >= 1e-2
            if not new:
                continue
            place = found
            while place > 0 and costs[i, place - 1] > cost:
                _copy(solutions[i, place - 1], solutions[i, place])
                costs[i, place] = costs[i, place - 1]
                place -= 1
            _copy(q, solutions[i, place])
            costs[i, place] = cost
            found += 1
            if found == wanted:
                break
    return solutions, costs, nearest, left


@compiled
def distinct(x, apart):  # type: ignore[no-untyped-def]
    """Rows of x (m, n) that differ from each kept row before by more than `apart` in some column: a mask (m)."""
    m, n = x.shape
    keep = np.ones(m, np.bool_)
    for i in range(m):
        for o in range(i):
            if not keep[o]:
                continue
            most = 0.0
            for j in range(n):
                most = max(most, abs(x[i, j] - x[o, j]))
            if not most > apart:
                keep[i] = False
                break
    return keep


@compiled
def follow_branches(fixed, starts, first, lower, upper, targets, L, limits):  # type: ignore[no-untyped-def]
    """Solutions followed from sample to sample, each by the smallest motion, to both ends of a trajectory.

    starts (b, n): configurations at sample `first` of t targets (t, 3, 4); lower, upper (t, n). Returns b paths
    (b, t, n) and whether each sample is exact (b, t); where it is not, the path stays where it was before.
    """
    b, n = starts.shape
    t = targets.shape[0]
    paths, exact = np.zeros((b, t, n)), np.zeros((b, t), np.bool_)
    q, before = np.empty(n), np.empty(n)
    for s in range(b):
        for way in (1, -1):
            _copy(starts[s], before)
            i = first
            while 0 <= i < t:
                for j in range(n):
                    q[j] = min(max(before[j], lower[i, j]), upper[i, j])
                position, angle = descend(fixed, q, lower[i], upper[i], targets[i], L, 30)
                if position <= limits[0] and angle <= limits[1]:
                    exact[s, i] = True
                    _copy(q, before)
                _copy(before, paths[s, i])
                i += way
    return paths, exact
