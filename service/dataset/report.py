"""The report of a run: one HTML file that opens anywhere, deviations first, pictures and errors after them."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from service.compute.budget.closure import Alignment
from service.core.gates import describe
from service.dataset.scene_view import Scene, SceneMesh, SceneSphere, decimated, scene_html
from service.dataset.summary import RunSummary
from service.store.audit import AuditReport

# The paper's table: mean radial error (mm) and mean reprojection error (px) by source and width of the images.
_PAPER = {
    ("robot", 9504): (0.89, 8.99),
    ("colmap", 1920): (1.10, 11.53),
    ("colmap", 4752): (0.37, 3.91),
    ("colmap", 9504): (0.35, 3.71),
    ("glomap", 9504): (0.44, 4.67),
}


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
        {**row, "paper": _paper(row), "true_error_mm": (true_error_mm or {}).get(row["poses"])}
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
        budget=summary.result("evaluation").get("budgets", {}).get(summary.best()),
        overlays=[(ref.original_name, _data_url(summary, ref.sha256)) for ref in summary.artefacts("overlay")],
        scene=_scene(summary),
        audit=audit,
        jobs=summary.jobs(),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(html, encoding="utf-8")


def _paper(row: Mapping[str, Any]) -> tuple[int, float, float] | None:
    """What the paper reached with this source: the width nearest to the row's, radial error, reprojection error."""
    width = int(str(row["resolution"]).split()[0])
    known = [at for source, at in _PAPER if source == row["source"]]
    if not known:
        return None
    at = min(known, key=lambda candidate: abs(np.log(candidate / width)))
    return (at, *_PAPER[row["source"], at])


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
    registered = registrations[best]
    points, triangles = decimated(*summary.scan_mesh())
    placed = Alignment(np.array(registered["T_world_scan"]), np.array(registered["covariance"])[:6, :6])
    error_mm = 1e3 * np.sqrt(np.trace(placed.covariance_at_m2(points), axis1=1, axis2=2))
    centres: list[tuple[float, float, float]] = summary.result("scan_import")["spheres_m"]
    scene = Scene(
        cameras={name: np.array(T) for name, T in registered["T_scan_camera"].items()},
        stations={c.viewpoint: c.station for c in summary.captures() if c.viewpoint in registered["T_scan_camera"]},
        spheres=[SceneSphere(str(i), "registration", centre) for i, centre in enumerate(centres)],
        radius_m=summary.protocol.spheres.radius_mm / 1000,
        mesh=SceneMesh(points, triangles, error_mm),
    )
    return scene_html(scene)


def _data_url(summary: RunSummary, sha256: str) -> str:
    data = base64.b64encode(summary.store.artefact_path(sha256).read_bytes()).decode()
    return f"data:image/jpeg;base64,{data}"
