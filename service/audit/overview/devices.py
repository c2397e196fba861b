"""What a run's devices said when they were opened, and which camera body its photographs state."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import Connection, text

from service.audit.record.queries import EventRow, plain
from service.core.equipment.camera_bodies import Bodies, bodies_of

_LOOKED_AT = 500  # photographs, the newest: one that states another body is an image that departs, which is judged


def bodies_of_run(connection: Connection, run_id: str, opened: Iterable[EventRow]) -> Bodies:
    """Serial numbers of the cameras. `opened`: its events device_opened with their payloads."""
    rows = connection.execute(
        text(
            "SELECT DISTINCT json_extract(e.payload, '$.camera.body_serial') AS body "
            "FROM (SELECT seq FROM event_index WHERE run_id = :run "
            "AND kind IN ('viewpoint_captured', 'view_held', 'view_imported') "
            "ORDER BY seq DESC LIMIT :most) AS i JOIN events AS e ON e.run_id = :run AND e.seq = i.seq ORDER BY 1"
        ),
        {"run": plain(run_id), "most": _LOOKED_AT},
    ).all()
    identities = (
        (str(row.payload.get("device", "")), (row.payload.get("report") or {}).get("identity") or {})
        for row in opened
    )
    return bodies_of(identities, (str(row.body or "") for row in rows))
