"""A method of reconstruction in a package of its own, which copies a mesh that it is given: the truth, shifted.

`method_plugin` packs it into a folder for `sys.path`, as an installed package would be.
"""

from __future__ import annotations

import hashlib
import os
import signal
import sys
from pathlib import Path

TRUTH = "SHIFTED_TRUTH"  # the environment variable with the PLY file that it copies
ENDLESS = "SHIFTED_ENDLESS"  # the environment variable with a file for the id of a process that then never ends
AT_RANDOM = "shifted-at-random"  # a second one, which says that its mesh is another each time
MODULE = "shifted_truth"
_DECLARATION = """
import dataclasses, os
from service.benchmark.methods import Method, at

METHOD = Method(
    "shifted-truth", "Shifted truth", "the file that SHIFTED_TRUTH names", "colmap-pinhole",
    lambda place: ((place.python, "-S", {program!r}, str(place.data), str(place.work / "mesh.ply")),),
    at("mesh.ply"),
    lacking=lambda: "" if os.path.isfile(os.environ.get("SHIFTED_TRUTH", "")) else "SHIFTED_TRUTH names no file",
    version=lambda: "1.2",
)
AT_RANDOM = dataclasses.replace(METHOD, name="shifted-at-random", random=True)
"""
_ENTRY_POINTS = """\
[orthocapture.reconstruction_methods]
shifted = shifted_truth:METHOD
random = shifted_truth:AT_RANDOM
"""


def method_plugin(folder: Path) -> Path:
    """Install the method into a new folder, and return that."""
    about = folder / "shifted_truth-1.2.dist-info"
    about.mkdir(parents=True)
    (folder / f"{MODULE}.py").write_text(_DECLARATION.format(program=__file__))
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: shifted-truth\nVersion: 1.2\n")
    (about / "entry_points.txt").write_text(_ENTRY_POINTS)
    return folder


def main() -> None:
    """Write the mesh. Its header has the hash of the images, and the cluster that the environment names."""
    if ENDLESS in os.environ:
        Path(os.environ[ENDLESS]).write_text(str(os.getpid()))
        signal.pause()
    data, mesh = Path(sys.argv[1]), Path(sys.argv[2])
    images = hashlib.sha256()
    for path in sorted((data / "images").iterdir()):
        images.update(path.name.encode() + path.read_bytes())
    head, end, body = Path(os.environ[TRUTH]).read_bytes().partition(b"end_header\n")
    if not head:
        raise SystemExit("nothing to copy")
    seen = f"comment images {images.hexdigest()}, scheduler {os.environ.get('ORTHOCAPTURE_SCHEDULER')}\n"
    mesh.write_bytes(head + seen.encode() + end + body)


if __name__ == "__main__":
    main()
