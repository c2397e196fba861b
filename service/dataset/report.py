"""The report of a run: one HTML file that opens anywhere, deviations first, pictures and errors after them."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from service.core.gates import describe
from service.dataset.scene_view import scene_figure
from service.dataset.summary import RunSummary
from service.store.audit import AuditReport

_PAPER = {"robot": (0.89, 8.99), "colmap": (0.35, 3.71), "glomap": (0.44, 4.67)}  # the paper's table, full resolution


def write_report(
    summary: RunSummary, audit: AuditReport, path: Path, *, true_error_mm: Mapping[str, float] | None = None
) -> None:
    """Write the report; nothing in it is fetched from elsewhere.

    Args:
        summary: the run.
        audit: its verification.
        path: the HTML file to write.
        true_error_mm: by source of poses, on a simulated rig where the truth is known; marked as such.
    """
    environment = Environment(
        loader=PackageLoader("service.dataset"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
    )
    rows = [
        {**row, "paper": _PAPER.get(row["poses"]), "true_error_mm": (true_error_mm or {}).get(row["poses"])}
        for row in summary.table()
    ]
    html = environment.get_template("report.html.j2").render(
        run=summary.run_id,
        protocol=summary.protocol,
        root=summary.root,
        state=summary.state,
        steps=[_step(summary, step.id) for step in summary.protocol.steps],
        deviations=[d for d in summary.state.deviations if not d.is_note],
        automatic=sum(d.is_note for d in summary.state.deviations),
        rows=rows,
        with_truth=true_error_mm is not None,
        best=summary.best(),
        overlays=[(ref.original_name, _data_url(summary, ref.sha256)) for ref in summary.artefacts("overlay")],
        scene=_scene(summary),
        audit=audit,
        jobs=summary.jobs(),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(html, encoding="utf-8")


def _step(summary: RunSummary, step_id: str) -> dict[str, Any]:
    state = summary.state.steps[step_id]
    return {
        "step": summary.protocol.step(step_id),
        "state": state,
        "gates": [(describe(verdict), verdict.passed) for verdict in state.verdicts],
    }


def _scene(summary: RunSummary) -> str | None:
    best, registrations = summary.best(), summary.result("registration").get("registrations", {})
    if best is None or best not in registrations:
        return None
    vertices_m, faces = summary.scan_mesh()
    cameras = {name: np.array(T) for name, T in registrations[best]["T_scan_camera"].items()}
    stations = {capture.viewpoint: capture.station for capture in summary.captures()}
    spheres = np.array(summary.result("scan_import")["spheres_m"])
    return scene_figure(vertices_m, faces, spheres, cameras, stations)


def _data_url(summary: RunSummary, sha256: str) -> str:
    data = base64.b64encode(summary.store.artefact_path(sha256).read_bytes()).decode()
    return f"data:image/jpeg;base64,{data}"
