"""Writes the benchmark's results: a table like the paper's, as Markdown and data, and a figure of all meshes."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.meshes.surface_file import read_surface_file
from service.benchmark.methods import Method, Workplace, missing
from service.benchmark.running import truth_file
from service.computations.benchmark import SCENARIOS, BenchmarkResult, Scenario
from service.compute.surfaces.chamfer import OUTLIER_M, DistanceSamples, sample
from service.compute.surfaces.heat_map import HeatScale, Panel, heat_bar, heat_row
from service.compute.surfaces.surface import PointIndex, Surface
from service.core.errors import DataError
from service.core.words import SIMULATED
from service.dataset.exporter import png

_NONE = "–"


def table_record(results: Sequence[BenchmarkResult], known: Mapping[str, Method]) -> dict[str, Any]:
    """Return all results; for each method without a result, what is missing, what it expects, and its commands."""
    done = {(result.method, result.scenario) for result in results}
    return {
        "results": [result.model_dump(mode="json") for result in results],
        "not_run": [
            {
                "method": name,
                "scenarios": [scenario for scenario in SCENARIOS if (name, scenario) not in done],
                "missing": missing(method),
                "expects": method.expects,
                "reads": method.form,
                "commands": [shlex.join(command) for command in method.commands(_named(method))],
            }
            for name, method in sorted(known.items())
            if any((name, scenario) not in done for scenario in SCENARIOS)
        ],
    }


def table_markdown(results: Sequence[BenchmarkResult], known: Mapping[str, Method]) -> str:
    """Format the results for people: the paper's Chamfer distances, then details, commands, and what was not run."""
    lines: list[str] = ["# Reconstruction from posed images", ""]
    for dataset in dict.fromkeys(result.dataset_sha256 for result in results):
        of = [result for result in results if result.dataset_sha256 == dataset]
        lines += _chamfer(of, known) + _details(of, known) + _commands(of, known)
    return "\n".join(lines + _not_run(table_record(results, known)["not_run"], known)) + "\n"


def _chamfer(results: Sequence[BenchmarkResult], known: Mapping[str, Method]) -> list[str]:
    by = {(result.method, result.scenario): result for result in results}
    names = list(dict.fromkeys(result.method for result in results))
    best = {
        scenario: min(
            (r.score.chamfer_mm for r in results if r.scenario == scenario and r.score is not None), default=0.0
        )
        for scenario in SCENARIOS
    }
    rows: list[str] = []
    for name in names:
        cells: list[str] = []
        for scenario in SCENARIOS:
            result = by.get((name, scenario))
            if result is None or result.score is None:
                cells.append(_NONE)
                continue
            text = f"{result.score.chamfer_mm:.2f}"
            cells.append(f"**{text}**" if result.score.chamfer_mm == best[scenario] else text)
        rows.append(f"| {_words(name, known)} | {' | '.join(cells)} |")
    origin = " It was made by a simulated rig." if results[0].simulated else ""
    return [
        f"Data set {results[0].dataset_sha256[:12]}.{origin}",
        "",
        "| Chamfer distance (mm) | Dense | Sparse |",
        "|---|---:|---:|",
        *rows,
        "",
    ]


def _details(results: Sequence[BenchmarkResult], known: Mapping[str, Method]) -> list[str]:
    head = (
        "method", "scenario", "views", "px", "Chamfer mm", "accuracy mm", "completeness mm", "F 0.5 mm", "F 1 mm",
        "normals", "wall s", "CPU s", "memory MB",
    )  # fmt: skip
    return [
        f"| {' | '.join(head)} |",
        "|---|---|" + "---:|" * (len(head) - 2),
        *(f"| {' | '.join(_detail_cells(result, known))} |" for result in results),
        "",
        *_remarks(results, known),
        "",
    ]


def _detail_cells(result: BenchmarkResult, known: Mapping[str, Method]) -> list[str]:
    score, effort = result.score, result.effort
    scores, took = [_NONE] * 6, [_NONE] * 3
    if score is not None:
        scores = [
            *(f"{x:.3f}" for x in (score.chamfer_mm, score.accuracy_mm, score.completeness_mm)),
            *(f"{x:.3f}" for x in (score.f_score_05, score.f_score_10, score.normal_consistency)),
        ]
    if effort is not None:
        took = [f"{effort.wall_s:.0f}", f"{effort.cpu_s:.0f}", f"{effort.peak_memory_mb:.0f}"]
    size = f"{result.width} × {result.height}"
    return [_words(result.method, known), result.scenario, str(result.views), size, *scores, *took]


def _remarks(results: Sequence[BenchmarkResult], known: Mapping[str, Method]) -> list[str]:
    floors = [result.score.floor_mm for result in results if result.score is not None]
    machines = dict.fromkeys(
        f"{m.processor}, {m.cores} cores, {m.memory_gb:g} GB, {m.gpu or 'no GPU'}"
        for m in (result.machine for result in results)
    )
    floor = [f"Equal surfaces would give {min(floors):.3f} mm, by the sampling alone."] if floors else []
    return [
        *floor,
        *(f"Machine: {machine}." for machine in machines),
        *(
            f"{_words(r.method, known)}, {r.scenario}: made elsewhere, mesh {r.mesh_sha256[:12]}."
            for r in results
            if r.elsewhere
        ),
        *(
            f"{_words(r.method, known)}, {r.scenario}: no mesh. {' '.join(r.failure.split())}"
            for r in results
            if r.failure
        ),
    ]


def _commands(results: Sequence[BenchmarkResult], known: Mapping[str, Method]) -> list[str]:
    lines = ["Command lines:", "", "```"]
    for result in results:
        lines.append(f"# {_words(result.method, known)}, {result.scenario}, {result.finished_utc}")
        lines += [shlex.join(command) for command in result.commands]
    return [*lines, "```", ""]


def _not_run(entries: Sequence[Mapping[str, Any]], known: Mapping[str, Method]) -> list[str]:
    if not entries:
        return []
    lines = ["## Not run", ""]
    for entry in entries:
        why = entry["missing"] or "ready to run here"
        lines += [
            f"{_words(entry['method'], known)} ({', '.join(entry['scenarios'])}): {why}. "
            f"It expects {entry['expects']}.",
            "",
            "```",
            *entry["commands"],
            "```",
            "",
        ]
    return lines


def _named(method: Method) -> Workplace:
    """Return a place with names instead of folders, for commands that are only shown."""
    checkout = f"${method.variable}" if method.variable else ""
    return Workplace(Path("DATA"), Path("WORK"), Path(checkout), "python")


def _words(name: str, known: Mapping[str, Method]) -> str:
    return known[name].words if name in known else name


SPACING_M = 4e-4  # of the samples that are drawn
FULL_M = 2e-3  # end of the colours: one scale for all figures
_PANEL_PX = 520


def figure(out: Path, results: Sequence[BenchmarkResult], known: Mapping[str, Method]) -> NDArray[np.uint8]:
    """Draw (H, W, 3), blue first: a row for each scenario and a column for each method, of the newest data set.

    Args:
        out: folder of the results, with the meshes as they were scored and the truth.
        results: the results in that folder.
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
    """Return the figure as PNG; raises as `figure`."""
    return png(figure(out, results, known), SIMULATED if _newest(out, results).simulated else "")


def _newest(out: Path, results: Sequence[BenchmarkResult]) -> BenchmarkResult:
    """Return the newest result with a mesh."""
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
