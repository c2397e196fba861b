"""The figure of the benchmark: the meshes of all methods side by side, by their distances from the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.meshes.surface_file import read_surface_file
from service.benchmark.method import Method
from service.benchmark.records import SCENARIOS, BenchmarkResult, Scenario
from service.benchmark.running import truth_file
from service.compute.ground_truth.distances.chamfer import OUTLIER_M, DistanceSamples
from service.compute.ground_truth.distances.heat_map import HeatScale, Panel, heat_bar, heat_row
from service.compute.ground_truth.distances.neighbours import PointIndex
from service.compute.ground_truth.distances.sampling import sample
from service.compute.ground_truth.surface import Surface
from service.core.errors import DataError
from service.dataset.formats.meshes import png
from service.dataset.posed.records import SIMULATED

SPACING_M = 4e-4  # of the samples that are drawn
FULL_M = 2e-3  # end of the colours: one scale for all figures
_PANEL_PX = 520


def figure(out: Path, results: Sequence[BenchmarkResult], known: Mapping[str, Method]) -> NDArray[np.uint8]:
    """(H, W, 3) picture, blue first: a row for each scenario and a column for each method, of the newest data set.

    Args:
        out: folder of the results, with the meshes as they were scored and the truth.
        results: from that folder.
        known: the methods.

    Raises:
        DataError: no method has a mesh, or a file is missing.
    """
    newest = _newest(out, results)
    dataset = newest.dataset_sha256
    by = {(r.method, r.scenario): r for r in results if r.score is not None and r.dataset_sha256 == dataset}
    names = sorted({method for method, _ in by})
    gt = _surface(truth_file(out, dataset))
    points = sample(gt, SPACING_M, np.random.default_rng(0)).points_m
    index, scale = PointIndex(points), HeatScale(FULL_M, OUTLIER_M)
    rows: list[NDArray[np.uint8]] = []
    for scenario in SCENARIOS:
        panels = [
            _panel(out, by.get((name, scenario)), _title(known, name, scenario), index, scale) for name in names
        ]
        rows.append(heat_row(panels, gt, points, _PANEL_PX))
    body = np.vstack(rows)
    parts = [body, heat_bar(body.shape[1], scale)]
    if newest.simulated:
        parts.append(_line("The data set is simulated.", body.shape[1]))
    return np.vstack(parts)


def figure_png(out: Path, results: Sequence[BenchmarkResult], known: Mapping[str, Method]) -> bytes:
    """The figure as PNG; raises as `figure`."""
    return png(figure(out, results, known), SIMULATED if _newest(out, results).simulated else "")


def _newest(out: Path, results: Sequence[BenchmarkResult]) -> BenchmarkResult:
    """The newest result with a mesh."""
    scored = [result for result in results if result.score is not None]
    if not scored:
        raise DataError("no method has a mesh yet", where=str(out), remedy="Run a method with `benchmark run`")
    return max(scored, key=lambda result: result.finished_utc)


def _line(words: str, width: int) -> NDArray[np.uint8]:
    line = np.full((34, width, 3), 255, dtype=np.uint8)
    cv2.putText(line, words, (20, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (40, 40, 40), 1, cv2.LINE_AA)
    return line


def _panel(out: Path, result: BenchmarkResult | None, title: str, index: PointIndex, scale: HeatScale) -> Panel:
    if result is None or result.score is None:
        return Panel(np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8), lambda _: None, f"{title}: -")
    surface = _surface(out / f"{result.method}-{result.scenario}" / "mesh.ply")
    samples = sample(surface, SPACING_M, np.random.default_rng(0))
    compared = DistanceSamples(samples, index.nearest(samples.points_m)[0])
    return Panel.of_distances(surface, compared, scale, f"{title}: {result.score.chamfer_mm:.2f} mm")


def _title(known: Mapping[str, Method], name: str, scenario: Scenario) -> str:
    return f"{known[name].words if name in known else name}, {scenario}"


def _surface(path: Path) -> Surface:
    file = read_surface_file(path, "m")
    return Surface(file.vertices_m, file.faces)
