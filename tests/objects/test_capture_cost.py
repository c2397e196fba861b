"""A capture does the same with an object store, without one, and with one that is away: no effect more or less."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from sqlalchemy import Engine, event

from service.core.errors import StoreError
from service.store.objects.s3 import S3Objects
from service.store.objects.upload import Uploader
from service.store.records import NewArtefact
from service.store.store import Store
from tests.support.processes.object_store import Weed
from tests.support.record.store import CrashingFiles, captured, start_run

_CAPTURES = 5


@contextmanager
def statements() -> Generator[list[str]]:
    """Collect the statements that any database of this process executes meanwhile."""
    found: list[str] = []

    def listen(_connection: object, _cursor: object, statement: str, *_rest: object) -> None:
        found.append(statement)

    event.listen(Engine, "before_cursor_execute", listen)
    try:
        yield found
    finally:
        event.remove(Engine, "before_cursor_execute", listen)


def effects(data: Path, objects: S3Objects | None) -> tuple[list[str], list[str]]:
    """Return the durable effects and statements of captures, between which an uploader is at work."""
    files = CrashingFiles()
    effects: list[str] = []
    executed: list[str] = []
    with ExitStack() as stack:
        store = stack.enter_context(Store.open(data, files=files))
        uploader = None if objects is None else Uploader(stack.enter_context(Store.open(data)), objects)
        run_id = start_run(store)
        for number in range(_CAPTURES):
            files.points.clear()
            with statements() as asked:
                content = b"photograph %d" % number
                ref = store.put_bytes(content, kind="image", media_type="image/jpeg", original_name="v.jpg")
                artefact = NewArtefact(ref, "camera", "capture", 1, f"v{number}")
                store.record(run_id, [captured(ref, f"v{number}")], actor="runner", artefacts=[artefact])
            effects += files.points
            executed += asked
            if uploader is not None:
                try:
                    uploader.drain()
                except StoreError:
                    assert data.name == "away"
    return effects, executed


def test_a_capture_has_the_same_effects_whatever_the_object_store_does(weed: Weed, tmp_path: Path) -> None:
    present = weed.write_site(tmp_path / "present")
    away = Weed(tmp_path / "gone").write_site(tmp_path / "away")  # never started
    without = effects(tmp_path / "absent", None)
    assert without[0].count("before commit") == _CAPTURES
    assert any(statement.startswith("INSERT INTO artefacts") for statement in without[1])
    assert effects(tmp_path / "present", present) == without
    assert effects(tmp_path / "away", away) == without
