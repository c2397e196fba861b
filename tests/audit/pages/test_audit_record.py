"""What the audit reads from the record of a large run: digest, searches, provenance, corrections and signatures."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.audit import findings, overview, queries
from service.audit.background import PartialProgress
from service.audit.filters import ArtefactFilter, EventFilter
from service.audit.findings import correct
from service.audit.findings import signatures as signatures_of
from service.audit.overview import digests
from service.audit.provenance import draw, graphs, origin
from service.audit.queries import EventPage
from service.core.errors import DataError
from service.core.records.run_events import StepNote
from service.core.run.fold import fold
from service.core.run.state import RunState
from service.run_start import recorded_run
from service.store.records import NewArtefact, UnknownRunError
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.waiting import until
from tests.support.record.outsider import tamper
from tests.support.record.store import captured, start_run
from tests.support.recorded.large_run import SMALL, Sizes, digest_of, write_large_run
from tests.support.runs.recorded_run import record_run


def folded(store: Store, run: str) -> RunState:
    protocol, _root = recorded_run(store, run)
    return fold(protocol, store.events(run))


# --- digest ---------------------------------------------------------------------------------------------------


def test_digest_agrees_with_the_fold_of_all_events(store: Store, run: str) -> None:
    digest, state = digest_of(store, run), folded(store, run)
    assert verify(store.database_path.parent).ok
    assert digest.problem == ""
    assert digest.state is not None
    assert digest.deviations == state.deviations
    assert {d.kind for d in state.deviations} >= {"refused", "viewpoint_skipped", "redo_viewpoint"}
    for field in ("status", "people", "superseded", "released_by", "current", "machine_state", "completed_sha256"):
        assert getattr(digest.state, field) == getattr(state, field), field
    assert overview.counts(digest)["skipped_views"] == sum(d.kind == "viewpoint_skipped" for d in state.deviations)
    assert sum(digest.facets.kinds.values()) == digest.seq == len(store.events(run))


@pytest.mark.slow
def test_digest_agrees_with_the_fold_after_a_redo_and_goes_on_from_where_it_was(tmp_path: Path) -> None:
    run = record_run(tmp_path, complete=False)
    with Store.open(tmp_path / "data") as store:
        computed = digests(store)
        first = computed.get(run, wait_s=60.0)
        assert not isinstance(first, PartialProgress)
        state = folded(store, run)
        assert (first.deviations, first.status) == (state.deviations, state.status)
        assert any(d.kind == "redo" for d in first.deviations)
        store.record(run, [StepNote(step="registration", attempt=1, note="later")], actor="runner")
        second = computed.get(run, wait_s=60.0)
        assert not isinstance(second, PartialProgress)
        assert second.seq == first.seq + 1
        assert second.facets.kinds["step_note"] == first.facets.kinds.get("step_note", 0) + 1
        with store.database.reading() as connection:
            (again,) = [s for s in findings.replaced_steps(connection, run, second) if s.step == "first_scan"]
        assert [attempt.attempt for attempt in again.attempts] == [1, 2]
        assert again.reasons[0][1] == "a hole"
        computed.close()


def test_digest_says_where_events_do_not_add_up(tmp_path: Path) -> None:
    write_large_run(tmp_path / "data", Sizes(200, 2, 3, 1, 1, 0, 0, 1, 0, 0))
    tamper(tmp_path / "data", "UPDATE events SET payload = '{' WHERE kind = 'step_passed' AND seq < 30")
    with Store.open(tmp_path / "data") as store:
        digest = digest_of(store, store.runs()[0].run_id)
        assert re.match(r"Event \d+ cannot be read", digest.problem)
        assert digest.status == "unknown"


def test_large_run_says_how_far_it_is_instead_of_waiting(store: Store, run: str) -> None:
    computed = digests(store)
    assert isinstance(computed.get(run), PartialProgress)
    until(lambda: not isinstance(computed.get(run), PartialProgress), "the digest", 20, every_s=0.02)
    computed.close()


# --- events -----------------------------------------------------------------------------------------------------


def page_of(store: Store, run: str, wanted: EventFilter, **where: int) -> EventPage:
    with store.database.reading() as connection:
        return queries.events_page(connection, run, wanted, **where)


def every_page(store: Store, run: str, wanted: EventFilter) -> list[int]:
    page, found = page_of(store, run, wanted), list[int]()
    while True:
        found += [row.seq for row in page.rows]
        if page.after is None:
            return found
        page = page_of(store, run, wanted, after=page.after)


def test_pages_of_a_filter_hold_every_event_once_in_order(store: Store, run: str) -> None:
    events = store.events(run)
    by_device = {a.seq for a in store.artefacts(run) if a.device == "camera"}
    for wanted, expected in (
        (EventFilter(), [e.seq for e in events]),
        (EventFilter(kind="step_note"), [e.seq for e in events if e.payload.kind == "step_note"]),
        (EventFilter(person="Grace"), [e.seq for e in events if e.actor == "Grace"]),
        (EventFilter(step="ct_import"), [e.seq for e in events if getattr(e.payload, "step", "") == "ct_import"]),
        (
            EventFilter(device="camera"),
            [e.seq for e in events if e.seq in by_device or getattr(e.payload, "device", "") == "camera"],
        ),
        (EventFilter(q="protective"), [e.seq for e in events if e.payload.kind == "device_trouble"]),
        (EventFilter(q="v00001"), [e.seq for e in events if '"v00001"' in e.payload.model_dump_json()]),
    ):
        assert every_page(store, run, wanted) == expected, wanted
        page = page_of(store, run, wanted)
        assert page.count == len(expected)
        assert page.missing == 0


def test_pages_go_back_the_way_they_came(store: Store, run: str) -> None:
    wanted = EventFilter(kind="step_note")
    first = page_of(store, run, wanted)
    assert first.before is None
    assert first.after is not None
    second = page_of(store, run, wanted, after=first.after)
    assert second.before is not None
    back = page_of(store, run, wanted, before=second.before)
    assert [row.seq for row in back.rows] == [row.seq for row in first.rows]
    assert back.before is None


@settings(max_examples=60, deadline=None)
@given(
    q=st.text(max_size=30) | st.sampled_from(['"', "a* OR b", "NEAR(a b)", "step:note", "%", "_", "'; --", "\ud800"]),
    step=st.text(max_size=8),
    after=st.integers(),
    before=st.integers(),
)
def test_no_filter_breaks_the_search(store: Store, run: str, q: str, step: str, after: int, before: int) -> None:
    page = page_of(store, run, EventFilter(q=q, step=step), after=after, before=before)
    assert page.count is not None
    assert len(page.rows) <= queries.PAGE


def test_every_event_shows_its_content_and_its_hash_holds(store: Store, run: str) -> None:
    events = store.events(run)
    with store.database.reading() as connection:
        for seq in (1, 2, len(events) // 2, len(events)):
            row = queries.one_event(connection, run, seq)
            event = events[seq - 1]
            assert (row.sha256, row.previous_sha256) == (event.sha256, event.previous_sha256)
            assert queries.computed_sha256(run, row) == row.sha256
            assert queries.seq_of_hash(connection, run, event.sha256) == seq
            assert row.payload == event.payload.model_dump(mode="json")
        assert queries.seq_of_hash(connection, run, "f" * 64) is None
        for seq in (0, -1, len(events) + 1, 10**30):
            with pytest.raises(UnknownRunError):
                queries.one_event(connection, run, seq)


def test_events_missing_from_the_index_are_told(tmp_path: Path) -> None:
    write_large_run(tmp_path / "data", Sizes(150, 1, 2, 0, 0, 0, 0, 1, 0, 0))
    tamper(tmp_path / "data", "DELETE FROM event_index WHERE seq = 5")
    with Store.open(tmp_path / "data") as store:
        page = page_of(store, store.runs()[0].run_id, EventFilter(kind="step_note"))
        assert page.missing == 1


# --- artefacts and provenance --------------------------------------------------------------------------------------


def test_artefacts_are_found_by_every_property(store: Store, run: str) -> None:
    every = store.artefacts(run)
    one = next(a for a in every if a.viewpoint == "v00007" and a.ref.kind == "image")
    with store.database.reading() as connection:
        for wanted, expected in (
            (ArtefactFilter(), len(every)),
            (ArtefactFilter(kind="ct_slice"), SMALL.slices),
            (ArtefactFilter(device="robot"), SMALL.viewpoints + SMALL.redone_viewpoints),
            (ArtefactFilter(viewpoint="v00007"), 2),
            (ArtefactFilter(q=one.ref.sha256[:16]), 1),
            (ArtefactFilter(q="dsc00007 image"), 1),
            (ArtefactFilter(q="%"), 0),
            (ArtefactFilter(q="SC0000_"), 0),
        ):
            found = queries.artefacts_page(connection, run, wanted)
            assert found.count == expected, wanted
        last = queries.artefacts_page(connection, run, ArtefactFilter(), page=10**9)
        assert last.page == last.pages
        with pytest.raises(UnknownRunError):
            queries.one_artefact(connection, run, "'; DROP TABLE artefacts")


@pytest.mark.parametrize(("q", "found"), [("Übersicht", 1), ("ÜBERSICHT", 1), ("bersicht.JPG", 1), ("Ubersicht", 0)])
def test_an_artefact_is_found_by_a_name_with_letters_of_any_language(tmp_path: Path, q: str, found: int) -> None:
    with Store.open(tmp_path / "data") as store:
        run = start_run(store)
        ref = store.put_bytes(b"x", kind="image", media_type="image/jpeg", original_name="Übersicht.jpg")
        store.record(
            run, [captured(ref, "v1")], actor="camera", artefacts=[NewArtefact(ref, "camera", "step", 1, "v1")]
        )
        with store.database.reading() as connection:
            assert queries.artefacts_page(connection, run, ArtefactFilter(q=q)).count == found


def test_provenance_runs_from_scans_to_the_registration(tmp_path: Path) -> None:
    run = record_run(tmp_path)
    with Store.open(tmp_path / "data") as store:
        computed = graphs(store)
        graph = computed.get(run, wait_s=60.0)
        computed.close()
        assert not isinstance(graph, PartialProgress)
        mesh, job = "file second_scan scan_mesh", "job second_scan locate_spheres"
        assert (mesh, job) in graph.edges
        # The sphere positions from the scan reach the registration as numbers, not as a file.
        assert any(source == job and graph.nodes[target].step == "registration" for source, target in graph.by_value)
        drawing = draw(graph)
        place = {box.node.key: box.x for box in drawing.boxes}
        assert place[mesh] < place[job]
        result = next(a for a in store.artefacts(run) if a.ref.kind == "registration")
        scan = next(a for a in store.artefacts(run) if a.ref.kind == "scan_mesh")
        with store.database.reading() as connection:
            assert origin(connection, run, result.ref.sha256).job is not None
            uses = origin(connection, run, scan.ref.sha256).used_by
        assert any(use.kind == "job_enqueued" for use in uses)


def test_files_of_a_job_are_its_inputs_and_its_results(store: Store, run: str) -> None:
    result = next(a for a in store.artefacts(run) if a.ref.kind == "live_view")
    image = next(a for a in store.artefacts(run) if a.ref.kind == "image")
    with store.database.reading() as connection:
        made = origin(connection, run, result.ref.sha256)
        source = origin(connection, run, image.ref.sha256)
    assert made.job is not None
    assert image.ref.sha256 in {row.ref.sha256 for row in made.inputs}
    assert result.ref.sha256 in {row.ref.sha256 for row in source.made_of_it}
    assert [row.ref.kind for row in source.beside] == ["pose_log"]


# --- corrections and signatures ---------------------------------------------------------------------------------


def test_correction_keeps_the_original_and_reads_the_old_value_itself(tmp_path: Path) -> None:
    run = record_run(tmp_path)
    with Store.open(tmp_path / "data") as store:
        correct(store, run, of_seq=2, field="host", new="table 2", reason="misnamed", actor="emmy")
        correct(store, run, of_seq=2, field="pid", new="7", reason="misread", actor="emmy")
        correct(store, run, of_seq=2, field="host", new="table 3", reason="again", actor="emmy")
        with store.database.reading() as connection:
            values = findings.corrected_values(connection, run)
            original = queries.one_event(connection, run, 2)
        assert [(v.correction.old, v.correction.new, v.original, v.latest) for v in values] == [
            ("here", "table 2", "here", False),
            (1, 7, 1, True),
            ("here", "table 3", "here", True),
        ]
        assert original.payload["host"] == "here"
        assert verify(tmp_path / "data").ok
        redo = next(event.seq for event in store.events(run) if event.payload.kind == "operator_action")
        for of_seq, field, new, reason in (
            (redo, "viewpoint", "1" + "0" * 400, "a number that no computer holds"),
            (2, "host", "here", "same"),
            (2, "pid", "seven", "not a number"),
            (2, "pid", "nan", "not finite"),
            (2, "resumed", "maybe", "not a truth"),
            (2, "software", "{}", "a table"),
            (2, "nothing.at.all", "1", "no such field"),
            (2, "host", "other", "   "),
            (1, "protocol.sha256", "f" * 64, "identity"),
            (values[0].seq, "new", "x", "a correction"),
        ):
            with pytest.raises(DataError):
                correct(store, run, of_seq=of_seq, field=field, new=new, reason=reason, actor="emmy")
        with pytest.raises(UnknownRunError):
            correct(store, run, of_seq=9999, field="host", new="x", reason="y", actor="emmy")


def test_signature_tells_what_it_binds_and_whether_that_was_altered(large: Path, store: Store, run: str) -> None:
    with store.database.reading() as connection:
        signed = signatures_of(connection, run, digest_of(store, run))
    assert signed
    for signature in signed:
        assert signature.bound is not None
        assert (signature.unaltered, signature.stands, signature.refused) == (True, True, False)
        assert signature.bound.sha256 == signature.signed_sha256


def test_altered_content_below_a_signature_shows(tmp_path: Path) -> None:
    run = record_run(tmp_path)
    with Store.open(tmp_path / "data") as store, store.database.reading() as connection:
        bound = signatures_of(connection, run, None)[-1].bound
    assert bound is not None
    tamper(tmp_path / "data", f"UPDATE events SET actor = 'Eve' WHERE seq = {bound.seq}")
    with Store.open(tmp_path / "data") as store, store.database.reading() as connection:
        signature = signatures_of(connection, run, None)[-1]
    assert not signature.unaltered
    assert signature.stands is None
