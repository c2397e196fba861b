"""All that a controller says of itself and its arm, for a recording."""

from __future__ import annotations

from drivers.errors import DeviceUnavailableError
from drivers.interfaces import DeviceAnswers, Sample
from drivers.ur import vendor as library
from drivers.ur.dashboard import Dashboard
from drivers.ur.link import vendor
from drivers.ur.primary import read_kinematics
from drivers.ur.samples import VARIABLES, stated_fields


def answers_of(
    host: str, dashboard: Dashboard, receive: library.Receive | None, *, kinematics_s: float
) -> DeviceAnswers:
    """Ask the dashboard and the primary interface, and read one sample of the stream if it is open."""
    exchanges, unanswered = dashboard.ask_all()
    silent = list(unanswered)
    samples: list[Sample] = []
    try:
        samples.append(
            Sample(source="primary interface, kinematics", fields=read_kinematics(host, kinematics_s).fields())
        )
    except DeviceUnavailableError as error:
        silent.append(error.what)
    if receive is None:
        silent.append("RTDE: the stream is not open")
    else:
        with vendor(host, "reading a sample"):
            sample = stated_fields(receive)
        samples.append(sample)
        silent += [f"RTDE: no number for {name}" for name in VARIABLES if name not in sample.fields]
    return DeviceAnswers(exchanges=exchanges, samples=tuple(samples), silent=tuple(silent))
