"""What is mutated: the sources of twelve subjects, in which a fault would cost safety, evidence or accuracy."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

# Glob patterns; `**` takes whole folders.
SUBJECTS: dict[str, tuple[str, ...]] = {
    "decide": ("service/core/run/**/*.py", "service/core/recovery.py"),
    "gates": ("service/core/gates.py", "service/core/protocol.py"),
    "leases": ("service/store/runs.py", "service/store/jobs.py"),
    "chain": ("service/store/events.py", "service/store/store.py", "service/store/durable_effects.py"),
    "signatures": ("service/store/signatures/*.py",),
    "verifier": ("service/store/verification/*.py", "service/audit/bundle_verifier.py"),
    "cost": tuple(f"service/compute/registration/{name}.py" for name in ("problem", "solve")),
    "covariances": (
        "service/compute/camera_model.py",
        "service/compute/registration/result.py",
        "service/compute/registration/further_camera.py",
        "service/compute/sfm/adjustment.py",
        "service/compute/sfm/estimate.py",
        "service/compute/calibration/intrinsics_quality.py",
        "service/dataset/view_covariances.py",
        "service/core/geometry.py",
    ),
    "exporters": ("service/dataset/formats/**/*.py", "service/dataset/exporter.py"),
    "fusion": (
        "service/compute/surfaces/fuse.py",
        "service/compute/surfaces/overlap.py",
        "service/compute/surfaces/align.py",
        "service/compute/surfaces/constellations.py",
    ),
    "watchdogs": ("drivers/arm/*.py", "drivers/ur/watchdog.py", "drivers/ur/safety.py", "drivers/host/heartbeat.py"),
    "authorisation": ("service/people/**/*.py",),
}
# Where the tests of each subject lie: of all that reach a place, these come first.
OWN_TESTS: dict[str, tuple[str, ...]] = {
    "decide": ("tests/core", "tests/recovery", "tests/run"),
    "gates": ("tests/core", "tests/protocol"),
    "leases": ("tests/store", "tests/run"),
    "chain": ("tests/store",),
    "signatures": ("tests/verify",),
    "verifier": ("tests/store", "tests/verify"),
    "cost": ("tests/registration",),
    "covariances": ("tests/registration", "tests/poses", "tests/calibration", "tests/second_camera", "tests/core"),
    "exporters": ("tests/dataset",),
    "fusion": ("tests/ground_truth", "tests/scanner"),
    "watchdogs": ("tests/robot", "tests/steps"),
    "authorisation": ("tests/people", "tests/server"),
}
# Where else fast tests reach them: only these folders are recorded (record.py).
TESTS = sorted({folder for own in OWN_TESTS.values() for folder in own} | {"tests/evaluation", "tests/audit"})


def sources(tree: Path) -> dict[str, list[str]]:
    """Return each subject's files, relative to the tree, in order."""
    return {subject: sorted(_found(tree, patterns)) for subject, patterns in SUBJECTS.items()}


def _found(tree: Path, patterns: tuple[str, ...]) -> Iterator[str]:
    for pattern in patterns:
        files = [path for path in tree.glob(pattern) if path.name != "__init__.py"]
        if not files:
            raise FileNotFoundError(
                f"nothing in {tree} is named {pattern}: correct tests/support/mutants/subjects.py"
            )
        yield from (path.relative_to(tree).as_posix() for path in files)
