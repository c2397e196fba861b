"""README.txt of a bundle: how to verify it, what is in it, and what that proves."""

from __future__ import annotations

from collections.abc import Sequence

from service.core.records.events import RunStarted

_TEXT = """Evidence of run {run_id}, exported by orthocapture

{warnings}To verify this bundle, on any machine with Python 3.9 or newer and the package `cryptography`, offline:

    python -I verify.py BUNDLE.zip --key FINGERPRINT

With -I, Python takes no module from beside verify.py in place of its own.
FINGERPRINT is the fingerprint of the site's signing key. Ask the site for it; do not take it from this bundle. The
site sees it with `orthocapture audit keys`. This bundle states that it is
{key_id}
A verifier that comes with what it verifies could be forged as well. Take verify.py from an installation or a release
of orthocapture that you trust (service/audit/verify/bundle_verifier.py, the same file byte for byte).

events.jsonl        everything that happened in the run: who, what, when (UTC and monotonic), one record per line.
                    sha256 is SHA-256 over the RFC 8785 canonical JSON of the other fields; previous_sha256 links
                    the records to a chain.
site_events.jsonl   the chain of the site: accounts and their roles, sign-ins, signing keys, starts of the service. It
                    is complete, because only an unbroken chain shows that no key was slipped in.
checkpoints.jsonl   Ed25519 signatures; each covers every event and every artefact row up to its own event.
timestamps.jsonl    time stamps (RFC 3161) that authorities gave for checkpoints, if any.
keys.jsonl          the public keys, oldest first; each signed its successor as its last act.
artefacts.jsonl     where each recorded file came from; the files are artefacts/ab/ab… named by their SHA-256.
jobs.jsonl          the computations and their arguments.
protocol.yaml, rig.yaml     as they were when the run began.
report.html         a report for people, made from these records up to the last event in this bundle. Open it in a
                    browser; it needs no network.
ro-crate-metadata.json      a description of this bundle for machines (RO-Crate 1.1).
manifest.json, manifest.sig every file with its hash, and the signature over that list.

What this proves: nothing was changed after the site's key signed it. What it cannot prove: that the people and
devices told the truth, or that nobody but the site had the key.
"""


def readme(run_id: str, key_id: str, root: RunStarted, missing: Sequence[str]) -> str:
    """The text of README.txt.

    Args:
        run_id: of the run.
        key_id: fingerprint of the site's signing key.
        root: the run's first event.
        missing: results that have not arrived yet, in words.
    """
    return _TEXT.format(run_id=run_id, key_id=key_id, warnings=_warnings(root, missing))


def _warnings(root: RunStarted, missing: Sequence[str]) -> str:
    """Paragraphs on a simulated rig, imported images and missing results; each ends with an empty line."""
    found: list[str] = []
    if root.simulated:
        found.append("SIMULATED: no real device took part in this run. It is not a record of a real acquisition.")
    if root.origin == "imported":
        found.append(
            "IMPORTED: how the images were captured is not in evidence, only when and by whom they were imported."
        )
    if missing:
        lines = "".join(f"\n  - {line}" for line in missing)
        found.append(
            "NOT IN YET: when this bundle was made, these results had not arrived. A later export has those that "
            f"came.{lines}"
        )
    return "".join(f"{text}\n\n" for text in found)
