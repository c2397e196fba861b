"""Starting and resuming a run: what is recorded first, and what is checked before anything moves."""

from __future__ import annotations

from collections.abc import Mapping
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING

from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.protocol import LoadedProtocol, Protocol
from service.core.records.entered import RunAbout
from service.core.records.events import ActionAfterEnd
from service.core.records.run_events import ActionRefused, OperatorAction, RunStarted
from service.core.run.state import RunState
from service.rig import Rig, RigDevice, parse_recorded_rig, read_rig
from service.run_record import recorded_protocol, recorded_root
from service.runner.held_run import software_versions
from service.steps.protocol_check import require_devices, require_plausible
from service.store.disk_space import forecast_of, require_space
from service.store.records import NewArtefact
from service.store.signatures.second_place import SecondPlace
from service.store.signatures.signing import require_signs_here
from service.store.store import Store

if TYPE_CHECKING:
    from service.store.signatures.timestamps import Authority

_SCHEMES = ("ptpip:", "socket://")


def require_runnable(loaded: LoadedProtocol, rig: Rig, devices: Mapping[str, RigDevice]) -> None:
    """Refuse what could not be run to its end: it would fail hours later, when little can be done again.

    Args:
        loaded: the protocol.
        rig: the rig. One without any device captures nothing, so that its stations and devices are not asked for.
        devices: the drivers' statements about the rig's devices, by name.

    Raises:
        ProtocolError: params name the wrong steps, a gate a measure that its step does not have, or a step a station
            that the rig does not have; or an arm would move too fast.
        ConfigurationError: the rig does not have a device of a step.
    """
    captures = bool(rig.section.devices)
    require_plausible(loaded, f"{loaded.protocol.id}.yaml", rig.section if captures else None, devices)
    if captures:
        require_devices(loaded.protocol, rig, devices)


def start_run(
    store: Store,
    loaded: LoadedProtocol,
    rig: Rig,
    *,
    operator: str,
    auto_confirm: bool,
    about: RunAbout | None = None,
) -> str:
    """Record the first event of a new run and return the run's name.

    Args:
        store: the data folder.
        loaded: the protocol.
        rig: the rig.
        operator: the person who starts the run.
        auto_confirm: true for automatic confirmations, on a simulated rig.
        about: the facts entered about the run.

    Raises:
        ConfigurationError: automatic confirmation is requested on a rig that is not simulated.
        SpaceShortError: the disk is too full to capture anything.
    """
    if auto_confirm:
        require_simulated(rig)
    require_space(store, forecast_of(store, loaded.protocol, simulated=rig.section.simulated))
    source = loaded.source.encode()
    protocol = store.put_bytes(
        source, kind="protocol", media_type="application/yaml", original_name=f"{loaded.protocol.id}.yaml"
    )
    imported = rig.section.imported is not None
    rig_ref = store.put_bytes(
        rig.source,
        kind="import_list" if imported else "rig",
        media_type="application/json" if imported else "application/yaml",
        original_name=str(rig.path),
    )
    payload = RunStarted(
        protocol_id=loaded.protocol.id,
        protocol_version=loaded.protocol.version,
        protocol_sha256=loaded.sha256,
        protocol=protocol,
        rig=rig_ref,
        simulated=rig.section.simulated,
        auto_confirm=auto_confirm,
        operator=operator,
        software=software_versions(),
        origin="imported" if imported else "captured",
        about=about if about != RunAbout() else None,
    )
    return store.create_run(payload, operator, [NewArtefact(protocol, "runner"), NewArtefact(rig_ref, "runner")])


def record_refusal(
    store: Store, run_id: str, state: RunState, action: OperatorAction, refusal: OrthocaptureError, actor: str
) -> None:
    """Record that an action was refused: in the run's chain, or in the site's if the run has ended."""
    why = str(refusal)
    if state.terminal:
        after = ActionAfterEnd(run=run_id, action=action.action, step=action.step, why=why)
        store.record_site([after], actor=actor, software=software_versions())
    else:
        store.record(run_id, [ActionRefused(action=action.action, step=action.step, why=why)], actor=actor)


def recorded_run(store: Store, run_id: str) -> tuple[Protocol, RunStarted]:
    """Return the protocol as recorded when the run began, and the payload of the run's first event."""
    root = recorded_root(store, run_id)
    return recorded_protocol(store, root), root


def recorded_rig(store: Store, root: RunStarted) -> Rig:
    """Return the rig of a run, from its file; for an import, from the recorded list.

    Raises ConfigurationError if the rig file has changed since the run began.
    """
    if root.origin == "imported":
        source = store.artefact_path(root.rig.sha256, verify=True).read_bytes()
        return parse_recorded_rig(source, Path(root.rig.original_name))
    path = Path(root.rig.original_name)
    source = read_rig(path)
    if source != store.artefact_path(root.rig.sha256, verify=True).read_bytes():
        raise ConfigurationError(
            "the rig file has changed since the run began",
            where=str(path),
            remedy="Restore it, or start a new run: calibration and poses belong to one rig",
        )
    return parse_recorded_rig(source, path)


def time_stamp_authority(rig: Rig) -> Authority | None:
    """Return the authority that stamps the end of runs of this rig, or None."""
    from service.store.signatures.timestamps import Authority  # noqa: PLC0415 - certificates, which `status` can do without

    section = rig.section.timestamp
    return None if section is None else Authority(section.url, rig.folder / section.certificates, section.timeout_s)


def signature_copy(rig: Rig) -> Path | None:
    """Return the path of the copy of the log of signatures, or None."""
    named = rig.section.signature_copy
    return None if named is None else rig.folder / named


def second_place(rig: Rig, store: Store) -> SecondPlace:
    """Return the second place of the signatures of a data folder, as the rig names it."""
    return SecondPlace.of(store.database_path.parent, signature_copy(rig), store.clock, store.files)


def require_rig_free(store: Store, rig: Path, *, run_id: str = "") -> None:
    """Raise ConfigurationError while a living process drives another run with the same rig file.

    `run_id` is the run to be driven; "" for a new one. Raises SignsElsewhereError if another data folder signs the
    site: each step of a run is signed at once.
    """
    require_signs_here(store)
    for other in store.runs():
        if other.run_id == run_id or not store.driven(other.run_id):
            continue
        theirs = store.events(other.run_id)[0].payload
        if isinstance(theirs, RunStarted) and theirs.rig.original_name == str(rig):
            raise ConfigurationError(
                f"the rig is in use by run {other.run_id}",
                where=str(rig),
                remedy="End that run, or wait until it has ended",
            )


def require_simulated(rig: Rig) -> None:
    """Raise ConfigurationError unless the rig is simulated and all its addresses are on this machine."""
    remedy = "Leave --auto-confirm out: on a real rig a person confirms every motion"
    if not rig.section.simulated:
        raise ConfigurationError(
            "automatic confirmation is for simulated rigs only", where=str(rig.path), remedy=remedy
        )
    for name, settings in rig.section.devices.items():
        address = str(settings.get("host") or settings.get("port") or "")
        if (":" in address or "host" in settings) and not _is_this_machine(address):
            raise ConfigurationError(
                f"device {name!r} at {address} is not on this machine, so the rig cannot be simulated",
                where=str(rig.path),
                remedy=remedy,
            )


def _is_this_machine(address: str) -> bool:
    for scheme in _SCHEMES:
        address = address.removeprefix(scheme)
    host = address.split(":")[0]
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
