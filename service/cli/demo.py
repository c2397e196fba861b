"""`orthocapture demo`: a whole run on a simulated rig over the real wire protocols, up to the registered data set."""

from __future__ import annotations

import json as json_module
import os
import selectors
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import ArrayLike
from rich.table import Table

from service.audit.data_set_export import export_data_set
from service.audit.exports import WantedExport
from service.audit.recorded_run import read_run
from service.audit.report import report_content
from service.audit.report_output import write_html
from service.cli.common import (
    JsonOption,
    console,
    error_console,
    print_json,
    print_table,
    progress_bar,
    reporting_errors,
    require_writable_folder,
    shipped_protocols,
)
from service.cli.ending import ExitStatus
from service.cli.run import drive, end_with_children, sigterm_like_ctrl_c
from service.computations.evaluate import Row
from service.compute.registration.accuracy import true_error_m
from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.geometry import Array, inverse
from service.core.protocol import LoadedProtocol, load_protocol
from service.core.units import mm
from service.dataset.export_folder import check_folder
from service.dataset.registrations import shared_adjustment_note
from service.dataset.summary import RunSummary, summarise
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.store import Store
from service.store.verification.verify import verify

_EXPORTED = WantedExport("plain")
_ARM_PORTS = (29999, 30003, 30004)  # of a Universal Robots controller


def demo_command(
    out: Annotated[Path, typer.Option("--out", help="Folder for the rig, the evidence and the report.")] = Path(
        "demo-run"
    ),
    scene: Annotated[int, typer.Option("--scene", help="Seed of the simulated scene.")] = 7,
    image_width: Annotated[int, typer.Option("--image-width", help="Width of the simulated photographs.")] = 1280,
    host: Annotated[
        str | None,
        typer.Option("--host", help="Address of the simulated arm, such as 127.0.0.2; default: one with free ports."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Run the demonstration protocol on a simulated rig and show the results. Takes a few minutes."""
    started_s = time.monotonic()
    with reporting_errors(json), sigterm_like_ctrl_c():
        require_writable_folder(out)
        folder = out.resolve() / time.strftime("%Y%m%d-%H%M%S")
        with _simulated_rig(folder / "rig", scene, image_width, host or free_address()) as ready:
            run_id = _run_to_its_end(folder / "data", ready.rig)
        with progress_bar(quiet=json) as progress:
            summary, truth, result = _evaluated(folder, run_id, ready.truth, started_s, progress)
    rows = summary.table()
    told = {**asdict(result), "table": [{**row.plain(), "true_error_mm": truth[row.poses]} for row in rows]}
    (folder / "result.json").write_text(json_module.dumps(told, indent=1) + "\n", encoding="utf-8")
    if json:
        print_json(told)
    else:
        _print(result, rows, truth)
    if not result.audit_ok:
        raise typer.Exit(ExitStatus.FAILED)


def _run_to_its_end(data: Path, rig_file: Path) -> str:
    """Drive a run of the demo's protocol and return its name. Raises OrthocaptureError if it does not complete."""
    rig = load_rig(rig_file)
    with Store.open(data) as store:
        run_id = start_run(store, _protocol(), rig, operator="demo", auto_confirm=True)
        state = drive(store, run_id, rig, data=data, auto_confirm=True, worker=True)
    if state.status != "completed":
        raise OrthocaptureError(f"the demo is {state.status}: {state.stop_reason}", where=state.current)
    return run_id


def _protocol() -> LoadedProtocol:
    return load_protocol(shipped_protocols() / "demo.yaml", params_models())


def _evaluated(
    folder: Path, run_id: str, truth_file: Path, started_s: float, progress: Callable[[str, int, int], None]
) -> tuple[RunSummary, dict[str, float], _Result]:
    """Export the data set, verify the record and write the report: summary, true errors in mm, and the result."""
    data, dataset, report = folder / "data", folder / "dataset", folder / "report.html"
    with Store.open(data) as store:
        summary = summarise(store, run_id, _protocol().protocol)
        export_data_set(store, run_id, _EXPORTED, dataset, "demo", progress)
        database = str(store.database_path)
    files = check_folder(dataset)
    audit = verify(data, run_id, progress).with_limits()  # with the record of the export
    truth = true_errors_mm(summary, truth_file)
    write_html(report_content(read_run(data, run_id), audit, true_error_mm=truth), report)
    compared = {name: round(value, 4) for name, value in summary.state.steps["ground_truth"].measures.items()}
    return (
        summary,
        truth,
        _Result(
            run=run_id,
            data_dir=str(data),
            database=database,
            artefacts=str(data / "artefacts"),
            dataset=str(dataset),
            report=str(report),
            audit_ok=audit.ok,
            dataset_files=files,
            chamfer_mm=compared["chamfer_ct_scan_mm"],
            ct_to_scan_mm=compared["ct_to_scan_mm"],
            scan_to_ct_mm=compared["scan_to_ct_mm"],
            ct_to_scan_median_mm=compared["ct_to_scan_median_mm"],
            scan_to_ct_median_mm=compared["scan_to_ct_median_mm"],
            chamfer_floor_mm=compared["chamfer_floor_mm"],
            duration_s=round(time.monotonic() - started_s, 1),
            table_note=shared_adjustment_note(summary.protocol, summary.state),
        ),
    )


def true_errors_mm(summary: RunSummary, truth_file: Path) -> dict[str, float]:
    """Return the true registration error, mm, at the scene's centre by source of poses, from the simulator's record.

    Only the demo and tests use it, after the run.
    """
    T_world_scan = json_module.loads(truth_file.read_text())["scans"][-1]["T_world_scan"]
    T_world_camera = true_cameras(summary, truth_file.parent / "truth_exposures.jsonl")
    spheres_m = summary.scan_spheres_m()
    return {
        source: true_error_mm(registration.T_scan_camera, T_world_camera, T_world_scan, spheres_m)
        for source, registration in summary.registrations().items()
    }


def true_cameras(summary: RunSummary, exposures_log: Path) -> dict[str, Array]:
    """Return the true T_world_camera (4, 4) of each capture's first file, by viewpoint, from the camera's log."""
    exposures = [json_module.loads(line) for line in exposures_log.read_text().splitlines() if line.strip()]
    by_sha256 = {exposure["sha256"]: np.array(exposure["T_world_camera"]) for exposure in exposures}
    return {
        capture.viewpoint: by_sha256[capture.artefacts[0].sha256]
        for capture in summary.captures()
        if capture.artefacts[0].sha256 in by_sha256
    }


def true_error_mm(
    T_scan_camera: Mapping[str, ArrayLike],
    T_world_camera: Mapping[str, ArrayLike],
    T_world_scan: ArrayLike,
    spheres_m: ArrayLike,
) -> float:
    """Return the true registration error in mm at the centre of the spheres.

    Args:
        T_scan_camera: the registration, by viewpoint.
        T_world_camera: the truth, by viewpoint.
        T_world_scan: the truth (4, 4).
        spheres_m: (M, 3) in the scan.
    """
    T_scan_world = inverse(np.asarray(T_world_scan, dtype=np.float64))
    true = np.array([T_scan_world @ np.asarray(T_world_camera[name]) for name in T_scan_camera])
    centre_m = np.asarray(spheres_m, dtype=np.float64).mean(axis=0)
    return mm(true_error_m(np.array(list(T_scan_camera.values())), true, centre_m))


def free_address() -> str:
    """Return the first loopback address where a simulated arm's ports are free; the arm's clients use fixed ports.

    Raises:
        ConfigurationError: they are free at no address.
    """
    for last in range(1, 255):
        address = f"127.0.0.{last}"
        if all(_is_free(address, port) for port in _ARM_PORTS):
            return address
    raise ConfigurationError(
        f"the ports {', '.join(map(str, _ARM_PORTS))} of a simulated arm are in use at every address of this machine",
        remedy="End the other simulated rigs, or name an address with --host",
    )


def _is_free(address: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True


@dataclass(frozen=True, slots=True)
class _SimulatedRig:
    """Files of a simulated rig: its rig file, and the truth about its scene."""

    rig: Path
    truth: Path


@contextmanager
def _simulated_rig(folder: Path, scene: int, image_width: int, host: str) -> Generator[_SimulatedRig]:
    """Run a simulated rig process around one scene until the end of this block."""
    folder.mkdir(parents=True)
    command = [
        sys.executable, "-m", "simulators", "rig", "--scene", str(scene), "--dir", str(folder),
        "--image-width", str(image_width), "--speed-up", "10", "--ct-voxel-mm", "1.0", "--ahead",
        "--host", host, "--patience", "20",
        "--parent", str(os.getpid()),
    ]  # fmt: skip
    log = folder / "rig.log"
    with log.open("w") as errors:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors, text=True
        )
    try:
        yield _ready(process, log, timeout_s=120)
    finally:
        end_with_children(process, grace_s=30.0)
        if process.stdout is not None:
            process.stdout.close()


def _ready(process: subprocess.Popen[str], log: Path, *, timeout_s: float) -> _SimulatedRig:
    assert process.stdout is not None
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        line = process.stdout.readline() if selector.select(timeout_s) else ""
    if not line:
        raise OrthocaptureError(
            "the simulated rig did not start", where=str(log), remedy="Read that log; is another rig running?"
        )
    said = json_module.loads(line)
    return _SimulatedRig(Path(said["rig"]), Path(said["truth"]))


@dataclass(frozen=True, slots=True)
class _Result:
    """The results of the demonstration, and how long it took."""

    run: str
    data_dir: str
    database: str
    artefacts: str
    dataset: str
    report: str
    audit_ok: bool
    dataset_files: int  # number of files, each of which has the hash that is listed
    chamfer_mm: float  # CT and scan, both ways
    ct_to_scan_mm: float
    scan_to_ct_mm: float
    ct_to_scan_median_mm: float  # the means hold what only one of them shows
    scan_to_ct_median_mm: float
    chamfer_floor_mm: float  # distance that equal surfaces would have
    duration_s: float
    table_note: str


def _print(result: _Result, rows: Sequence[Row], true_error_mm: Mapping[str, float]) -> None:
    error_console.print()
    table = Table(title="Registration error on the control spheres", title_justify="left")
    table.add_column("camera poses")
    for heading in ("mean radial error (mm)", "mean reprojection error (px)", "true error (mm)"):
        table.add_column(heading, justify="right")
    for row in rows:
        reprojection_px = row.mean_reprojection_error_px
        table.add_row(
            row.poses,
            f"{row.mean_radial_error_mm:.3f}",
            "" if reprojection_px is None else f"{reprojection_px:.2f}",
            f"{true_error_mm[row.poses]:.3f}",
        )
    print_table(table)
    if result.table_note:
        console.print(result.table_note)
    made = {
        "run": result.run,
        "database": result.database,
        "artefacts": result.artefacts,
        "dataset": f"{result.dataset}, {result.dataset_files} files verified",
        "report": result.report,
    }
    for name, place in made.items():
        console.print(f"{name:<10} {place}")
    console.print(
        f"{'Chamfer':<10} CT and scan {result.chamfer_mm:.2f} mm (mean {result.ct_to_scan_mm:.2f} and "
        f"{result.scan_to_ct_mm:.2f}, median {result.ct_to_scan_median_mm:.2f} and "
        f"{result.scan_to_ct_median_mm:.2f}; equal surfaces {result.chamfer_floor_mm:.2f})"
    )
    console.print(f"{'audit':<10} {'verified' if result.audit_ok else 'FAILED'}")
    console.print(f"{'took':<10} {result.duration_s:.0f} s")
