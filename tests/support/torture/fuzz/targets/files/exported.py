"""Fuzz targets for what was exported, scored or drawn before: data sets, image pairs, results, regions."""

from __future__ import annotations

import functools
import hashlib
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np

from service.audit.exports import ExportRequest, WantedExport, keep_request, kept_request
from service.benchmark.matching import (
    MethodResult,
    markdown,
    open_matching_data,
    read_result,
    results_in,
    write_result,
)
from service.benchmark.methods import from_unit_box, methods
from service.benchmark.table import table_markdown
from service.computations.benchmark import RESULT, BenchmarkResult, ComputingEffort, Machine, Score, read_results
from service.compute.matching.scores import PRECISION_PX, LoadedViews, PairScore, PoseError
from service.compute.surfaces.surface import Surface, read_ply, write_ply
from service.core.text_files import parse_json
from service.dataset.export_folder import SUMS
from service.dataset.exporter import exporter, write_data_set
from service.dataset.formats.hdf5 import data_set_of_folder
from service.dataset.preview_records import CoveragePreview, Preview, ViewPreview, read_preview, write_preview
from service.run_acts import read_region
from service.store.events import canonical
from tests.support.scenes.posed import posed_data_set
from tests.support.torture.fuzz.mutations import BYTES, JSON, TEXT
from tests.support.torture.fuzz.targets.target import MisbehavedError, Target

_VIEWS = 3


@functools.cache
def _written(form: str) -> Path:
    """A small data set in a format; written once for each process."""
    place = Path(tempfile.mkdtemp(prefix="exported-"))
    (place / "photographs").mkdir()
    write_data_set(posed_data_set(place / "photographs", _VIEWS), exporter(form), place / form)
    return place / form


def _with_sums(folder: Path) -> None:
    """Write the checksums again: what is altered here came so from a laboratory."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != SUMS)
    lines = [f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.relative_to(folder).as_posix()}\n" for p in paths]
    (folder / SUMS).write_text("".join(lines))


# --- data sets ----------------------------------------------------------------------------------------------------


def _data_set(file: str, data: bytes, folder: Path) -> None:
    """Read a data set in which one file is the input."""
    place = folder / "data"
    shutil.copytree(_written("hdf5"), place)
    _one(place, file).write_bytes(data)
    _with_sums(place)
    dataset = data_set_of_folder(place)
    for view in dataset.views:
        dataset.pixels.colours(view)
        dataset.pixels.depth_m(view)
        if not np.isfinite(view.T_world_camera).all():
            raise MisbehavedError("a pose that is not finite is accepted")


def _of(form: str, file: str, _: Path) -> list[bytes]:
    return [_one(_written(form), file).read_bytes()]


def _one(folder: Path, file: str) -> Path:
    """The first file of this name or pattern."""
    return min(folder.glob(file))


def _sums(data: bytes, folder: Path) -> None:
    place = folder / "data"
    shutil.copytree(_written("hdf5"), place)
    (place / SUMS).write_bytes(data)
    data_set_of_folder(place)


# --- pairs of images ----------------------------------------------------------------------------------------------


def _pairs(file: str, data: bytes, folder: Path) -> None:
    """Read pairs of a data set in which one file is the input."""
    place = folder / "data"
    shutil.copytree(_written("matching"), place)
    _one(place, file).write_bytes(data)
    found = open_matching_data(place)
    views = LoadedViews(found)
    for pair in found.pairs[:4]:
        for end in (pair["first"], pair["second"]):
            views.read(end)


def _matching_results(folder: Path) -> list[bytes]:
    scores = tuple(
        PairScore(f"a{k}", "b", "easy", 90, 80, (0.5,) * len(PRECISION_PX), PoseError(1.0, 2.0), 70, 0.4, 0.1)
        for k in range(3)
    )
    write_result(folder / "sift.json", MethodResult("sift", "SIFT", "0" * 64, simulated=True, scores=scores))
    return [(folder / "sift.json").read_bytes()]


def _matching_result(data: bytes, folder: Path) -> None:
    (folder / "sift.json").write_bytes(data)
    read_result(folder / "sift.json")
    markdown(results_in(folder)).encode()


# --- the benchmark of reconstruction --------------------------------------------------------------------------------


def _results(_: Path) -> list[bytes]:
    score = Score(**dict.fromkeys(Score.model_fields, 0.4))
    result = BenchmarkResult(
        method="stereo", scenario="dense", dataset_sha256="0" * 64, simulated=True, views=36, width=960, height=640,
        commands=(("python", "-m", "x"),), elsewhere=False,
        effort=ComputingEffort(wall_s=1.0, cpu_s=2.0, peak_memory_mb=300.0), mesh_sha256="1" * 64, faces=100,
        score=score, failure="", finished_utc="2026-11-24T10:00:00Z",
        machine=Machine(processor="x", cores=2, memory_gb=8.0, gpu=""),
    )  # fmt: skip
    other = result.model_copy(update={"effort": None, "score": None, "failure": "no mesh", "scenario": "sparse"})
    return [one.model_dump_json().encode() for one in (result, other)]


def _result(data: bytes, folder: Path) -> None:
    (folder / "stereo-dense").mkdir()
    (folder / "stereo-dense" / RESULT).write_bytes(data)
    table_markdown(read_results(folder), methods()).encode()


def _boxes(_: Path) -> list[bytes]:
    return [json.dumps({"mesh_axes": [1, 2, 0], "centre_m": [0.1, 0.2, 0.3], "scale": 1.0}).encode()]


def _box(data: bytes, folder: Path) -> None:
    (folder / "unit_box.json").write_bytes(data)
    if from_unit_box(np.eye(3), folder).shape != (3, 3):
        raise MisbehavedError("points of another shape are returned")


def _plys(folder: Path) -> list[bytes]:
    surface = Surface(np.eye(3), np.array([[0, 1, 2]]))
    write_ply(folder / "mesh.ply", surface, 1e-3, {"source": np.arange(3, dtype=np.uint8)}, ["a comment"])
    return [(folder / "mesh.ply").read_bytes()]


def _ply(data: bytes, folder: Path) -> None:
    (folder / "mesh.ply").write_bytes(data)
    read_ply(folder / "mesh.ply")


# --- pages --------------------------------------------------------------------------------------------------------


def _previews(folder: Path) -> list[bytes]:
    view = ViewPreview("v0", 48, 32, ("dense",), "v0.webp", "v0.jpg", "v0-depth.webp", 1.0, 2.0)
    write_preview(folder, Preview((view,), (16, 16), CoveragePreview((1.0, 0.9, 0.5, 0.1), "coverage.json")))
    return [path.read_bytes() for path in folder.iterdir()]


def _preview(data: bytes, folder: Path) -> None:
    (folder / "preview.json").write_bytes(data)
    read_preview(folder)


def _requests(folder: Path) -> list[bytes]:
    keep_request(folder / "run", ExportRequest("run", WantedExport("colmap"), "ada", "2026-11-24T10:00:00Z"))
    return [path.read_bytes() for path in folder.iterdir()]


def _request(data: bytes, folder: Path) -> None:
    (folder / ".run.wanted").write_bytes(data)
    kept_request(folder / "run")


def _regions(_: Path) -> list[bytes]:
    corners = [[0.01, 0.0, 0.02], [0.03, 0.0, 0.02], [0.02, 0.02, 0.025]]
    return [json.dumps({"corners": json.dumps(corners), "along": "[0, 0, 1]"}).encode(), json.dumps(corners).encode()]


def _region(data: bytes, _: Path) -> None:
    """Read the form of a drawn polygon: both fields, or the corners alone as they are typed."""
    text = data.decode(errors="replace")
    form = {"corners": text, "along": text}
    try:
        document = parse_json(data, name="form")
    except Exception:  # noqa: BLE001 - not a form: its text is a field
        document = None
    if isinstance(document, dict):
        form = {name: str(document.get(name, value)) for name, value in form.items()}
    region = read_region("fuse", "ct", form["corners"][:40_000], form["along"][:400])
    canonical(region.model_dump(mode="json"))


_H5 = "service.dataset.formats.hdf5:data_set_of_folder"
_MATCHING = "service.benchmark.matching:open_matching_data"
TARGETS: tuple[Target, ...] = (
    *(
        Target(f"data_set_{name}", _H5, functools.partial(_data_set, file), functools.partial(_of, "hdf5", file),
               kinds, pace=0.3)
        for name, file, kinds in (
            ("statement", "dataset.json", JSON), ("splits", "splits.json", JSON), ("index", "data.h5", BYTES),
            ("view", "views/*.h5", BYTES),
        )
    ),
    Target("data_set_sums", _H5, _sums, functools.partial(_of, "hdf5", SUMS), TEXT, pace=0.3),
    *(
        Target(f"matching_{name}", _MATCHING, functools.partial(_pairs, file),
               functools.partial(_of, "matching", file), kinds, pace=0.3)
        for name, file, kinds in (
            ("views", "views.json", JSON), ("pairs", "pairs.json", JSON), ("depth", "depth/*", BYTES)
        )
    ),
    Target(
        "matching_result", "service.benchmark.matching:read_result", _matching_result, _matching_results, JSON
    ),
    Target("benchmark_result", "service.computations.benchmark:read_results", _result, _results, JSON),
    Target("unit_box", "service.benchmark.methods:from_unit_box", _box, _boxes, JSON),
    Target("own_ply", "service.compute.surfaces.surface:read_ply", _ply, _plys),
    Target("preview", "service.dataset.preview_records:read_preview", _preview, _previews, JSON),
    Target("export_request", "service.audit.exports:kept_request", _request, _requests, JSON),
    Target("region", "service.run_acts:read_region", _region, _regions, JSON),
)  # fmt: skip
