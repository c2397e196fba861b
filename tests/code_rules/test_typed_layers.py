"""What crosses a layer has a type: no public function takes or gives a `dict[str, Any]`, but for the edges below."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
UNTYPED = re.compile(r"\b(dict|Mapping|MutableMapping)\[str, (Any|object)\]")

# The modules in which JSON, rows of SQL or messages of a child process become records, or records become these.
EDGES = {
    # recorded events and arguments of jobs, before their records are read and after they are written
    "service/audit/findings.py": "a correction names any field of any recorded event",
    "service/audit/queries.py": "shows recorded events even where they are altered and no longer records",
    "service/audit/replay.py": "arguments of a job with recomputed answers, before its kind reads them",
    "service/core/jobs.py": "hashes recorded arguments of any kind of job; references as they stand in them",
    "service/core/records/base.py": "writes a record into an event",
    "service/import_folder.py": "the camera of an event, as a photograph states it",
    "service/computations/kind.py": "reads and writes the arguments and answers of jobs",
    "service/steps/exposure.py": "the camera of an event, as a photograph states it",
    "service/worker/following.py": "arguments of a job with references resolved, before its kind reads them",
    "service/computations/job.py": "writes an answer into an event",
    # rows of SQL, and their hashes
    "service/people/person.py": "the row of a session, which is hashed",
    "service/store/events.py": "hashes and writes the rows of events",
    "service/store/artefacts.py": "hashes the row of an artefact",
    "service/store/runs.py": "values of a row",
    "service/store/signatures/checkpoints.py": "payloads of rows, from which keys of every version are read",
    "service/store/store.py": "an answer as it is written into its event",
    "service/store/verification/chain_checks.py": "checks rows that may be altered and no longer records",
    "service/store/verification/file_checks.py": "checks rows that may be altered and no longer records",
    "service/store/verification/people_checks.py": "checks rows that may be altered and no longer records",
    "service/store/verification/signature_checks.py": "checks rows that may be altered and no longer records",
    "service/audit/bundle_verifier.py": "stands alone in a bundle, with nothing but the standard library",
    # files
    "service/compute/hand_held.py": "writes and reads the file of a hand-held image",
    "service/compute/markers/records.py": "writes and reads files of outlines",
    "service/compute/pipeline.py": "writes the result of `orthocapture register`",
    "service/compute/poses/pose_files.py": "reads JSON files",
    "service/core/protocol.py": "the JSON schema of a protocol",
    "service/benchmark/matching.py": "writes a result of the benchmark of matching",
    "service/benchmark/table.py": "writes the table of a benchmark",
    "service/dataset/crate.py": "writes ro-crate-metadata.json",
    "service/dataset/descriptions.py": "writes croissant.json",
    "service/dataset/run_data_set.py": "writes dataset.json",
    "service/dataset/formats/radiance.py": "writes unit_box.json",
    "service/computations/hand_held/compute.py": "writes and reads the file of a hand-held image",
    "service/computations/live/compute.py": "writes and reads the file of an image of the robot",
    # messages of COLMAP's child process
    "service/compute/sfm/colmap_process.py": "messages of a child process",
    "service/compute/sfm/child.py": "messages of a child process",
    # JSON that commands print
    "service/cli/evaluate.py": "prints JSON",
    "service/cli/fuse.py": "prints JSON",
    "service/cli/audit.py": "prints JSON",
    "service/cli/replay.py": "prints JSON",
    "service/cli/runs.py": "prints JSON",
    "service/cli/import_command.py": "prints JSON",
}


def _functions(node: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """The public functions of a module, and the public methods of its public classes."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef) and not child.name.startswith("_"):
            yield from _functions(child)
        elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) and not child.name.startswith("_"):
            yield child


def _annotations(function: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[str]:
    given = function.args
    for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg):
        if argument is not None and argument.annotation is not None:
            yield ast.unparse(argument.annotation)
    if function.returns is not None:
        yield ast.unparse(function.returns)


def untyped(source: str) -> list[str]:
    """The public functions of a module whose signature has a mapping of names to anything."""
    if UNTYPED.search(source) is None:  # spares parsing most modules
        return []
    return [
        f"{function.name} (line {function.lineno})"
        for function in _functions(ast.parse(source))
        if any(UNTYPED.search(annotation) for annotation in _annotations(function))
    ]


def test_no_public_function_takes_or_gives_a_mapping_to_anything() -> None:
    found = {
        str(path.relative_to(REPOSITORY)): untyped(path.read_text("utf-8"))
        for path in sorted((REPOSITORY / "service").rglob("*.py"))
    }
    wrong = {path: names for path, names in found.items() if names and path not in EDGES}
    assert not wrong, "give these a record: a frozen dataclass, or a pydantic model where JSON is read or written"
    assert not [path for path in EDGES if not found.get(path)], "these modules are no such edges any more"


def test_it_sees_parameters_results_and_methods() -> None:
    source = """
def given(data: Mapping[str, Any]): ...
async def gives() -> list[dict[str, object]]: ...
def _private(data: dict[str, Any]): ...
def typed(data: Mapping[str, float]): ...
class Public:
    def method(self, *, data: dict[str, Any] | None = None): ...
class _Private:
    def method(self, data: dict[str, Any]): ...
"""
    assert [name.split(" ")[0] for name in untyped(source)] == ["given", "gives", "method"]
