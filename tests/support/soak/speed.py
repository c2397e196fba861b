"""`speed`: the store compared with standard tools, on the same files and in alternation.

Ingest: `sha256sum FILE`, `cp FILE COPY`, `sync COPY` against what a capture does with its photograph
(`Store.put_file` and the transaction with row and event). Both end with the image on the disk; the store also records
its name. Verification: `sha256sum` of all stored files against `audit verify`, with the files in the page cache and
with them evicted from it.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from service.store.records import NewArtefact
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.store import captured, start_run

LEAST = 0.8  # minimum speed as a fraction of the tools' speed


def speed(folder: Path, rounds: int, files: int, megabytes: float) -> dict[str, Any]:
    """Run `rounds` rounds with `files` images of `megabytes`; returns median speeds, their ratios, and the faults."""
    sources = folder / "sources"
    sources.mkdir(parents=True)
    size = int(megabytes * 1e6)
    images = [sources / f"DSC{number:05d}.JPG" for number in range(files)]
    for image in images:
        image.write_bytes(os.urandom(size))
    with Store.open(folder / "data") as store:
        ingested = _ingest(store, folder / "copies", images, rounds)
    stored = sorted(path for path in (folder / "data" / "artefacts").rglob("*") if path.is_file())
    total = sum(path.stat().st_size for path in stored)
    warm = _verify(folder / "data", stored, rounds, cold=False)
    cold = _verify(folder / "data", stored, rounds, cold=True)
    rows = [
        _row("ingest", "sha256sum, cp, sync", size, ingested),
        _row("verify, cached", "sha256sum", total, warm),
        _row("verify, from the disk", "sha256sum", total, cold),
    ]
    if shutil.which("openssl"):
        rows.append(_row("verify, cached", "openssl dgst", total, {**warm, "tools": warm["openssl"]}))
    # OpenSSL can be faster than coreutils: reported, but not required.
    faults = [
        f"{row['what']}: {row['ratio']:.2f} of the speed of {row['against']}, less than {LEAST:g}"
        for row in rows
        if row["ratio"] < LEAST and row["against"] != "openssl dgst"
    ]
    return {"rounds": rounds, "images": files, "megabytes": megabytes, "verified_bytes": total} | {
        "rows": rows,
        "faults": faults,
    }


def _ingest(store: Store, copies: Path, images: Sequence[Path], rounds: int) -> dict[str, list[float]]:
    run_id = start_run(store)
    copies.mkdir()
    seconds: dict[str, list[float]] = {"tools": [], "store": []}
    number = 0
    for _round in range(rounds):
        for image in images:
            number += 1
            _renew(image)  # the store keeps identical content only once
            copy = copies / image.name

            def tools(image: Path = image, copy: Path = copy) -> None:
                for words in (("sha256sum", str(image)), ("cp", str(image), str(copy)), ("sync", str(copy))):
                    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)

            def through_the_store(image: Path = image, name: str = f"v{number}") -> None:
                ref = store.put_file(image, kind="image", media_type="image/jpeg")
                row = NewArtefact(ref, "camera", "capture", 1, name, "Ada")
                store.record(run_id, [captured(ref, name)], actor="runner", artefacts=[row])

            ways = {"tools": tools, "store": through_the_store}
            for way in ways if number % 2 else reversed(ways):
                seconds[way].append(_timed(ways[way]))
            copy.unlink()
    return seconds


def _verify(data: Path, stored: Sequence[Path], rounds: int, *, cold: bool) -> dict[str, list[float]]:
    names = [str(path) for path in stored]

    def sums(*words: str) -> Callable[[], None]:
        return lambda: _quietly([*words, *names])

    def verified() -> None:
        report = verify(data)
        assert report.ok, report.first_fault

    ways: dict[str, Callable[[], None]] = {"tools": sums("sha256sum"), "store": verified}
    if shutil.which("openssl"):
        ways["openssl"] = sums("openssl", "dgst", "-sha256")
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    for path in stored:
        path.read_bytes()
    for number in range(rounds):
        for way in ways if number % 2 else reversed(ways):
            if cold:
                _out_of_the_cache(stored)
            seconds[way].append(_timed(ways[way]))
    return seconds


def _quietly(words: Sequence[str]) -> None:
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)


def _renew(path: Path) -> None:
    """Replace the content by other bytes of the same length, on the disk and in the page cache."""
    with path.open("r+b") as handle:
        handle.write(os.urandom(32))
        handle.flush()
        os.fsync(handle.fileno())


def _out_of_the_cache(paths: Sequence[Path]) -> None:
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


def _timed(act: Callable[[], None]) -> float:
    began_s = time.perf_counter()
    act()
    return time.perf_counter() - began_s


def _row(what: str, against: str, size: int, seconds: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    ours, theirs = statistics.median(seconds["store"]), statistics.median(seconds["tools"])
    return {
        "what": what,
        "against": against,
        "mb_per_s": round(size / 1e6 / ours, 1),
        "against_mb_per_s": round(size / 1e6 / theirs, 1),
        "ratio": round(theirs / ours, 3),
        "times": len(seconds["store"]),
        "store_s": [round(s, 4) for s in seconds["store"]],
        "against_s": [round(s, 4) for s in seconds["tools"]],
    }


def table(found: Mapping[str, Any]) -> list[str]:
    """Format the findings as Markdown lines."""
    lines = [
        f"{found['rounds']} rounds with {found['images']} images of {found['megabytes']:g} MB, in turn with the "
        f"tools; then {found['verified_bytes'] / 1e9:.2f} GB verified {found['rounds']} times. Medians.",
        "",
        "| what | store, MB/s | against | MB/s | ratio | at least |",
        "|---|---:|---|---:|---:|---:|",
    ]
    for row in found["rows"]:
        least = "told only" if row["against"] == "openssl dgst" else f"{LEAST:g}"
        lines.append(
            f"| {row['what']} | {row['mb_per_s']:.0f} | {row['against']} | {row['against_mb_per_s']:.0f} | "
            f"{row['ratio']:.2f} | {least} |"
        )
    return lines
