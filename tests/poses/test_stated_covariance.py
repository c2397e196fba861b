"""The covariance of robust estimates: its constants against integrals, its matrices against dense ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.sparse import csr_matrix

from service.compute.sfm.adjustment import (
    CAUCHY,
    EXPECTED,
    clustered_information,
    inverse_information,
    reduced_rows,
    stated_covariance,
    taken_by_points,
)
from service.compute.sfm.bundle import Rows, normal_equations
from service.core.errors import ComputeError
from service.core.geometry import Array

N, SEEN = 5, 4  # frame parameters; observations a point, of two rows each
ROBUST = {"tracks": (2.4, 2), "spheres": (3.0, 3), "robot_position": (3.0, 3), "robot_rotation": (3.0, 3)}


def mean(of: Callable[[float], float], dimensions: int) -> float:
    """Expectation of a function of the squared length of a normal vector."""
    from scipy.stats import chi2  # noqa: PLC0415 - half a second in every worker, as nothing else needs it

    return quad(lambda s: of(s) * chi2.pdf(s, dimensions), 0, np.inf)[0]


def ratios(name: str) -> tuple[float, float]:
    """Slope and influence of a component's score over its expected weight."""
    scale, k = ROBUST[name]

    def w(s: float) -> float:
        return 1 / (1 + s / scale**2)

    weight = mean(w, k)
    slope = mean(lambda s: w(s) - 2 * s / k * w(s) ** 2 / scale**2, k)
    return slope / weight, mean(lambda s: w(s) ** 2 * s, k) / k / weight


def test_the_expected_moments_are_those_of_cauchy_weights() -> None:
    assert {name: scale for name, (scale, _) in ROBUST.items()} == CAUCHY
    assert set(EXPECTED) == set(ROBUST)
    for name, (scale, k) in ROBUST.items():
        found = EXPECTED[name]
        assert found.weight == pytest.approx(mean(lambda s, c=scale: 1 / (1 + s / c**2), k), rel=5e-3)
        assert found.square == pytest.approx(mean(lambda s, c=scale: s / (1 + s / c**2), k) / k, rel=5e-3)
        slope, influence = ratios(name)
        assert found.slope / found.weight == pytest.approx(slope, rel=5e-3)
        assert found.influence / found.weight == pytest.approx(influence, rel=5e-3)
        assert 0.3 < found.influence < found.slope < found.square < found.weight < 1


def tracks(points: int, seed: int, *, noise: float = 1.0, shared: bool = False) -> Rows:
    """Observations of points with unit errors; `shared`: each track has one error, which all its rows repeat."""
    rng = np.random.default_rng(seed)
    rows = 2 * SEEN * points
    frame = rng.normal(size=(rows, N))
    point = np.zeros((rows, 3 * points))
    for p in range(points):
        point[2 * SEEN * p : 2 * SEEN * (p + 1), 3 * p : 3 * p + 3] = rng.normal(size=(2 * SEEN, 3))
    error = np.repeat(rng.normal(size=points), 2 * SEEN) if shared else rng.normal(size=rows)
    return Rows(noise * error, csr_matrix(frame), csr_matrix(point), 2)


def others(name: str, points: int, seed: int) -> Rows:
    """Rows of a component that tells of the frame alone."""
    frame = 3 * np.random.default_rng([seed, len(name)]).normal(size=(12, N))
    return Rows(np.zeros(12), csr_matrix(frame), csr_matrix((12, 3 * points)), 3)


def without_points(rows: Rows) -> Array:
    """(n, n) information on the frame with the points eliminated, densely."""
    A, B = rows.frame.toarray(), rows.point.toarray()
    return A.T @ A - A.T @ B @ np.linalg.solve(B.T @ B, B.T @ A)


def test_the_rows_of_a_component_follow_the_points() -> None:
    seen = tracks(20, 1)
    sphere = Rows(np.zeros(60), csr_matrix(np.ones((60, N))), csr_matrix(np.eye(60)), 3)
    normal = normal_equations([seen, sphere])
    A = np.vstack([seen.frame.toarray(), sphere.frame.toarray()])
    B = np.vstack([seen.point.toarray(), sphere.point.toarray()])
    follow = np.linalg.solve(B.T @ B, B.T @ A)
    assert np.allclose(reduced_rows(seen, normal), seen.frame.toarray() - seen.point.toarray() @ follow, atol=1e-8)
    taken = [np.trace(P @ np.linalg.solve(B.T @ B, P.T)) for P in (seen.point.toarray(), sphere.point.toarray())]
    assert [taken_by_points(rows, normal) for rows in (seen, sphere)] == pytest.approx(taken, rel=1e-8)
    assert sum(taken) == pytest.approx(60)


@pytest.mark.parametrize("noise", [1.0, 2.0])
def test_scores_of_many_independent_tracks_are_what_normal_errors_give(noise: float) -> None:
    rows = tracks(400, 2, noise=noise)
    sloped, spread = clustered_information(rows, N)
    information = without_points(rows)
    assert np.allclose(sloped, ratios("tracks")[0] * information, rtol=5e-3, atol=5e-3 * np.trace(information))
    free = len(rows.residual) - 3 * 400  # what the points take of their own residuals is no part of a score
    assert np.trace(spread) == pytest.approx(np.trace(_scores(rows)) * free / (free - N), rel=0.02)
    assert np.linalg.eigvalsh(spread).min() > 0.3 * noise**2 * np.linalg.eigvalsh(information).min()


def _scores(rows: Rows) -> Array:
    """(n, n) sum of the squared scores of whole tracks."""
    of_tracks = (rows.residual[:, None] * rows.frame.toarray()).reshape(-1, 2 * SEEN, N).sum(axis=1)
    return of_tracks.T @ of_tracks


def test_errors_that_a_track_shares_count_as_often_as_they_are_repeated() -> None:
    alone, shared = (np.trace(clustered_information(tracks(300, 3, shared=s), N)[1]) for s in (False, True))
    assert shared / alone == pytest.approx(1.0, rel=0.3), "random derivatives: the repeated error does not add up"
    rows = tracks(300, 3, shared=True)
    ones = Rows(rows.residual, csr_matrix(np.ones((len(rows.residual), 1))), rows.point, 2)
    assert clustered_information(ones, 1)[1][0, 0] == pytest.approx((2 * SEEN) ** 2 * 300, rel=0.25)


def test_many_tracks_tell_by_themselves_which_parameter_errs_most() -> None:
    """Half of them know the first parameters alone and err by three times as much as the others."""
    rows = tracks(400, 6)
    noisy = np.arange(len(rows.residual)) // (2 * SEEN) % 2 == 0
    frame = np.where(noisy[:, None] == (np.arange(N) < 2), rows.frame.toarray(), 0.0)
    apart = Rows(np.where(noisy, 3.0, 1.0) * rows.residual, csr_matrix(frame), rows.point, 2)
    spread, information = np.diag(clustered_information(apart, N)[1]), np.diag(without_points(apart))
    noisy_share, other_share = (spread / information)[:2].mean(), (spread / information)[2:].mean()
    assert noisy_share / other_share == pytest.approx(9.0, rel=0.25)


def test_few_tracks_leave_no_parameter_without_errors() -> None:
    """The plain sum of squared scores of three tracks has rank three; the shrunk one has all five."""
    rows = tracks(3, 4)
    _, spread = clustered_information(rows, N)
    information = without_points(rows)
    assert np.linalg.matrix_rank(_scores(rows)) == 3
    assert np.linalg.matrix_rank(spread) == N
    assert np.linalg.eigvalsh(spread).min() > 0.05 * np.linalg.eigvalsh(information).min()


def test_the_stated_covariance_is_the_sandwich_of_all_components() -> None:
    count = 60
    weighted = {
        "tracks": tracks(count, 5),
        **{name: others(name, count, 5) for name in ("spheres", "robot_position", "robot_rotation", "centres")},
    }
    found = stated_covariance(weighted, N)
    information, spread = clustered_information(weighted["tracks"], N)
    for name in ("spheres", "robot_position", "robot_rotation", "centres"):
        slope, influence = ratios(name) if name in ROBUST else (1.0, 1.0)  # a prior is not robust
        JJ = weighted[name].frame.toarray()
        information = information + slope * JJ.T @ JJ
        spread = spread + influence * JJ.T @ JJ
    expected = np.linalg.inv(information) @ spread @ np.linalg.inv(information)
    assert np.allclose(found, expected, rtol=5e-3, atol=1e-3 * np.trace(expected))


def test_what_the_data_leave_open_is_refused() -> None:
    units = np.diag([1e3, 1.0, 1e-3])
    H = units @ np.array([[2.0, 0.4, 0.1], [0.4, 1.0, 0.3], [0.1, 0.3, 3.0]]) @ units
    assert np.allclose(inverse_information(H) @ H, np.eye(3), atol=1e-9)
    with pytest.raises(ComputeError, match="not determined by the data"):
        inverse_information(np.diag([1.0, 0.0]))
    with pytest.raises(ComputeError, match="frame, scale or a camera is free"):
        inverse_information(np.ones((2, 2)))
