"""Runs one method in one scenario, export, run and return to the world frame, and scores its mesh as in the paper."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import trimesh

from drivers.meshes.surface_file import read_surface_file
from service.benchmark import measured
from service.benchmark.methods import Command, Method, Workplace, missing, place_of
from service.computations.benchmark import RESULT, BenchmarkResult, ComputingEffort, Machine, Scenario, Score
from service.compute.surfaces.chamfer import ChamferScore, ChamferSettings, chamfer
from service.compute.surfaces.fuse import compact
from service.compute.surfaces.heat_map import HeatScale, heat_picture
from service.compute.surfaces.overlap import Box
from service.compute.surfaces.surface import Surface, write_ply
from service.core.errors import ComputeError, ConfigurationError, DataError
from service.core.geometry import inverse
from service.core.units import gigabytes, megabytes, mm
from service.dataset.exporter import exporter, png, write_data_set
from service.dataset.formats.hdf5 import scaled_data_set
from service.dataset.records import DataSet, Mesh
from service.machine.executors import VARIABLE
from service.machine.resources import large_arrays_returned, processor_model
from service.store.artefacts import hash_file
from service.store.durable_effects import DurableFiles

MARGIN_M = 0.002
SCORED, HEAT_MAP = "mesh.ply", "heat_map.png"  # what is written of a scored mesh
_POINTS = 200_000  # of the truth, by which its box is found


@dataclass(frozen=True, slots=True)
class Scored:
    """A mesh that was compared: what is left of it, with the comparison."""

    surface: Surface = field(repr=False)
    chamfer: ChamferScore = field(repr=False)
    score: Score


@large_arrays_returned()
def score_mesh(found: Surface, truth: Mesh, settings: ChamferSettings | None = None) -> Scored:
    """Compare a mesh with the truth; both in the world frame, metres.

    The mesh is first cropped to the smallest bounding box of the truth, enlarged by MARGIN_M: methods reconstruct the
    whole room, the truth only the specimen.

    Raises:
        DataError: nothing of the mesh is within the box.
        ComputeError: the meshes cannot be compared.
    """
    cut = _cropped(found, _box_around(truth, MARGIN_M))
    if not cut.is_mesh or not cut.area_m2 > 0:
        raise DataError(
            "the mesh has no face within the box of the ground truth",
            remedy="Check that the mesh is the file as the method wrote it, and that it belongs to this data set",
        )
    return compare(cut, truth, settings, 100 * max(0.0, 1 - cut.area_m2 / found.area_m2))


def _box_around(mesh: Mesh, margin_m: float) -> Box:
    """Return the smallest box around a mesh, and a margin."""
    points = mesh.vertices_m[:: max(1, len(mesh.vertices_m) // _POINTS)]
    to_origin, extents = trimesh.bounds.oriented_bounds(points)
    return Box(inverse(np.asarray(to_origin)), np.asarray(extents) + 2 * margin_m)


def _cropped(surface: Surface, box: Box) -> Surface:
    """Return the faces whose centres are in a box."""
    within = np.empty(len(surface.faces), dtype=np.bool_)
    for block in surface.blocks():
        within[block] = box.contains(surface.vertices_m[surface.faces[block]].mean(axis=1))
    return compact(surface.vertices_m, surface.faces[within])[0]


def compare(
    cut: Surface, truth: Mesh, settings: ChamferSettings | None = None, outside_percent: float = 0.0
) -> Scored:
    """Compare a mesh with the truth as they are; both in the world frame, metres.

    Args:
        cut: the mesh without what the truth does not cover.
        truth: the mesh that it is compared with.
        settings: the settings of the comparison.
        outside_percent: share of the method's surface that was cut off before.

    Raises:
        ComputeError: the meshes cannot be compared.
    """
    compared = chamfer(cut, Surface(truth.vertices_m, truth.faces), settings)
    forth, back = compared.pred_to_gt, compared.gt_to_pred
    consistency = [n for n in (forth.normal_consistency, back.normal_consistency) if n is not None]
    f_score_05, f_score_10 = compared.f_scores
    return Scored(
        cut,
        compared,
        Score(
            chamfer_mm=mm(compared.chamfer_m),
            accuracy_mm=mm(forth.mean_m),
            completeness_mm=mm(back.mean_m),
            floor_mm=mm(compared.floor_m),
            spacing_mm=mm((settings or ChamferSettings()).spacing_m),
            f_score_05=f_score_05,
            f_score_10=f_score_10,
            normal_consistency=sum(consistency) / len(consistency),
            outside_percent=outside_percent,
            excluded_percent=100 * (forth.excluded + back.excluded) / (forth.n + back.n),
            seen_percent=100 * back.within[1],
        ),
    )


def write_scored(scored: Scored, dataset: DataSet, folder: Path, settings: ChamferSettings | None = None) -> None:
    """Write the mesh as it was scored (`mesh.ply`, metres, world frame) and its heat maps (`heat_map.png`).

    Both say so if the data set is simulated.
    """
    comments = ["world frame, metres; cut to the box of the truth", dataset.mark]
    write_ply(folder / SCORED, scored.surface, 1.0, {}, list(filter(None, comments)))
    scale = HeatScale.of(scored.chamfer, (settings or ChamferSettings()).outlier_m)
    truth = Surface(dataset.mesh.vertices_m, dataset.mesh.faces)
    names = ("prediction", "simulated truth" if dataset.simulated else "truth")
    picture = heat_picture(scored.surface, truth, scored.chamfer, scale, names)
    (folder / HEAT_MAP).write_bytes(png(picture, dataset.mark))


_LAST_LINES = 12  # of a failed program's output, for the message
_ANSWER_S = 10.0  # that the NVIDIA driver may take to name its GPU


def run_commands(
    commands: tuple[Command, ...], work: Path, log: Path, environment: Mapping[str, str] = os.environ
) -> ComputingEffort:
    """Run commands one after the other in a folder, with their output in a file.

    Raises:
        ConfigurationError: a program cannot be started.
        ComputeError: one ended with another status than 0; the message has its last lines.
    """
    wall_s = cpu_s = peak_bytes = 0.0
    log.write_bytes(b"")
    for command in commands:
        took = _measured(command, work, log, environment)
        wall_s += took["wall_s"]
        cpu_s += took["cpu_s"]
        peak_bytes = max(peak_bytes, took["peak_bytes"])
        if took["status"] != 0:
            last = log.read_text(encoding="utf-8", errors="replace").splitlines()[-_LAST_LINES:]
            raise ComputeError(
                f"{command[0]} ended with status {took['status']}:\n" + "\n".join(last),
                where=shlex.join(command),
                remedy=f"Its whole output is in {log}",
            )
    return ComputingEffort(
        wall_s=round(wall_s, 2), cpu_s=round(cpu_s, 2), peak_memory_mb=round(megabytes(peak_bytes))
    )


def _measured(command: Command, work: Path, log: Path, environment: Mapping[str, str]) -> dict[str, Any]:
    """Run a command, and return its status and what it took, as `measured.py` says it."""
    reading, writing = os.pipe()
    with log.open("ab") as output, os.fdopen(reading, "rb") as said:
        output.write(f"$ {shlex.join(command)}\n".encode())
        output.flush()
        try:
            process = subprocess.Popen(
                [sys.executable, "-I", "-S", measured.__file__, str(writing), *command],
                cwd=work, env=environment, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                pass_fds=(writing,),
            )  # fmt: skip
        finally:
            os.close(writing)
        answer = said.read()
        process.wait()
    if not answer:
        raise ComputeError(f"{command[0]} was ended from outside", where=shlex.join(command))
    took: dict[str, Any] = json.loads(answer)
    if "refused" in took:
        raise ConfigurationError(f"{command[0]} cannot be started: {took['refused']}", where=shlex.join(command))
    return took


def this_machine() -> Machine:
    """Return the machine that this program runs on."""
    return Machine(
        processor=processor_model(),
        cores=os.cpu_count() or 1,
        memory_gb=round(gigabytes(psutil.virtual_memory().total), 1),
        gpu=_gpu(),
    )


def _gpu() -> str:
    program = shutil.which("nvidia-smi")
    if program is None:
        return ""
    try:
        answer = subprocess.run(
            [program, "--query-gpu=name", "--format=csv,noheader"],
            capture_output=True, text=True, timeout=_ANSWER_S, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return answer.stdout.strip().splitlines()[0] if answer.returncode == 0 and answer.stdout.strip() else ""


_IDENTITY = "identity.txt"
OUTPUT = "output.txt"  # of the method's commands
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of a method on one split of the data set, and its settings.

    Attributes:
        method: the method of reconstruction.
        scenario: the split of the data set that it gets.
        out: folder of all results.
        mesh: a mesh made elsewhere, as the method writes it; None to run the method here.
        width: the images' width in pixels; 0 for that of the data set.
        settings: the settings of the comparison.
        here_alone: the commands do not see the cluster that the environment names.
    """

    method: Method
    scenario: Scenario
    out: Path
    mesh: Path | None = None
    width: int = 0
    settings: ChamferSettings = field(default_factory=ChamferSettings)
    here_alone: bool = False

    @property
    def folder(self) -> Path:
        """The folder of its export, its mesh and its result."""
        return self.out / f"{self.method.name}-{self.scenario}"


def run_trial(
    trial: Trial, whole: DataSet, progress: Progress = lambda _what, _done, _total: None
) -> BenchmarkResult:
    """Run a method, or take its mesh, and score that; the result is stored in the trial's folder.

    A method that is installed and makes no mesh has a result without a score, as COLMAP in the paper's sparse
    scenario.

    Args:
        trial: the run.
        whole: the data set, as `data_set_of_folder` reads it.
        progress: called with a text of what is being done.

    Raises:
        ConfigurationError: the method is not installed; what it reads has been exported, and the message has its
            commands.
        DataError: the data set or the mesh cannot be used.
        ComputeError: the mesh cannot be compared.
    """
    dataset = whole.keeping(whole.splits.named()[trial.scenario])
    if trial.width:
        dataset = scaled_data_set(dataset, trial.width)
    trial.folder.mkdir(parents=True, exist_ok=True)
    place = place_of(trial.method, trial.folder)
    progress("writing what the method reads", 0, 0)
    _export(trial, dataset, place.data)
    commands = trial.method.commands(place)
    mesh, effort, failure = _mesh(trial, place, commands, progress)
    write_truth(trial.out, whole.identity, whole.mesh, whole.mark)
    score, sha256, faces = _scored(trial, mesh, dataset, progress) if mesh is not None else (None, "", 0)
    result = BenchmarkResult(
        method=trial.method.name,
        scenario=trial.scenario,
        dataset_sha256=whole.identity,
        simulated=whole.simulated,
        views=len(dataset.views),
        width=dataset.views[0].camera.width,
        height=dataset.views[0].camera.height,
        commands=commands,
        elsewhere=trial.mesh is not None,
        effort=effort,
        mesh_sha256=sha256,
        faces=faces,
        score=score,
        failure=failure,
        machine=this_machine(),
        finished_utc=datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
        version="" if effort is None else trial.method.version(),
        random=trial.method.random,
    )
    write_result(trial.folder, result)
    return result


def write_truth(out: Path, dataset_sha256: str, mesh: Mesh, mark: str) -> None:
    """Write a data set's ground truth beside the results, unless it is there."""
    truth = truth_file(out, dataset_sha256)
    if not truth.is_file():
        comments = list(filter(None, ("world frame, metres", mark)))
        write_ply(truth, Surface(mesh.vertices_m, mesh.faces), 1.0, {}, comments)


def truth_file(out: Path, dataset_sha256: str) -> Path:
    """Return the path of a data set's ground truth, which is stored beside the results for the figure."""
    return out / f"truth-{dataset_sha256[:12]}.ply"


def _export(trial: Trial, dataset: DataSet, data: Path) -> None:
    """Write what the method reads, unless it is there already."""
    identity = f"{trial.method.form} {trial.scenario} {dataset.identity}"
    written = trial.folder / _IDENTITY
    if data.is_dir() and written.is_file() and written.read_text(encoding="utf-8") == identity:
        return
    written.unlink(missing_ok=True)
    if data.is_dir():
        shutil.rmtree(data)
    write_data_set(dataset, exporter(trial.method.form), data)
    written.write_text(identity, encoding="utf-8")


def _require_installed(trial: Trial, commands: tuple[Command, ...]) -> None:
    lacks = missing(trial.method)
    if lacks:
        lines = "\n".join(f"    {' '.join(command)}" for command in commands)
        raise ConfigurationError(
            f"{trial.method.words} cannot run here: {lacks}",
            where=f"--method {trial.method.name}",
            remedy=f"It expects {trial.method.expects}. Install that, or run these commands elsewhere and give the "
            f"mesh with --mesh:\n{lines}",
        )


def _mesh(
    trial: Trial, place: Workplace, commands: tuple[Command, ...], progress: Progress
) -> tuple[Path | None, ComputingEffort | None, str]:
    """Return the mesh given or made, what it took to make it, and why there is none."""
    if trial.mesh is not None:
        return trial.mesh, None, ""
    _require_installed(trial, commands)
    progress(f"running {trial.method.words}", 0, 0)
    try:
        effort, mesh = _run(trial, place, commands)
    except (ComputeError, DataError) as error:
        return None, None, str(error)
    return mesh, effort, ""


def _run(trial: Trial, place: Workplace, commands: tuple[Command, ...]) -> tuple[ComputingEffort, Path]:
    if place.work.exists():
        shutil.rmtree(place.work)
    place.work.mkdir()
    cluster = VARIABLE if trial.here_alone else ""
    environment = {name: value for name, value in os.environ.items() if name != cluster}
    effort = run_commands(commands, place.work, trial.folder / OUTPUT, environment)
    return effort, trial.method.mesh(place)


def _scored(trial: Trial, mesh: Path, dataset: DataSet, progress: Progress) -> tuple[Score, str, int]:
    progress("comparing with the ground truth", 0, 0)
    file = read_surface_file(mesh, "m")
    if not len(file.faces):
        raise DataError(
            "a mesh with faces is needed", where=str(mesh), remedy="Give the method's mesh, not its cloud"
        )
    surface = Surface(trial.method.to_world(file.vertices_m, place_of(trial.method, trial.folder).data), file.faces)
    scored = score_mesh(surface, dataset.mesh, trial.settings)
    write_scored(scored, dataset, trial.folder, trial.settings)
    return scored.score, hash_file(mesh)[0], len(file.faces)


def write_result(folder: Path, result: BenchmarkResult) -> None:
    """Write a result into its folder, durably."""
    path = folder / RESULT
    part = path.with_suffix(".part")
    part.write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
    DurableFiles().sync_file(part)
    part.replace(path)
