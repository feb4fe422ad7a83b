"""Meshes of a scene: found on this machine, named as the scene names them."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterable, Iterator, Mapping
from os import PathLike
from pathlib import Path


def find(
    files: Iterable[str], folder: Path, packages: Mapping[str, str | PathLike[str]]
) -> Iterator[tuple[str, bytes | None]]:
    """The files with their bytes, or None where there are none, and with what they refer to."""
    waiting, seen = list(files), set()
    while waiting:
        file = waiting.pop()
        if file in seen:
            continue
        seen.add(file)
        place = next((place for place in _places(file, folder, packages) if place.is_file()), None)
        data = place.read_bytes() if place else None
        yield file, data
        waiting += _references(file, data or b"")


def _places(
    file: str, folder: Path, packages: Mapping[str, str | PathLike[str]]
) -> Iterator[Path]:
    package = re.fullmatch(r"(?:package|model)://([^/]+)/(.*)", file, flags=re.S)
    if package is None:
        yield folder / file.removeprefix("file://")
        return
    name, path = package.groups()
    if name in packages:
        yield Path(packages[name]) / path
        return
    # Where robots are kept, the file stands in its package, or beside it.
    around = [folder.absolute(), *folder.absolute().parents]
    yield from (above / path for above in around if above.name == name)
    yield from (above / name / path for above in around)


def _references(file: str, data: bytes) -> list[str]:
    """Materials of an obj, pictures of an mtl or a dae."""
    end = file.rsplit(".", 1)[-1].lower()
    text = data.decode(errors="replace") if end in ("obj", "mtl", "dae") else ""
    if end == "obj":
        lines = re.findall(r"^\s*mtllib\s+(.+)$", text, flags=re.M)
        names = [name for line in lines for name in line.split()]
    elif end == "mtl":
        lines = re.findall(r"^\s*(?:map_\w+|bump|disp|norm)\s+(.+)$", text, flags=re.M)
        names = [line.split()[-1] for line in lines if line.split()]
    else:
        names = re.findall(r"<init_from>\s*([^<]*\.[^<]*?)\s*</init_from>", text)
    scheme, path = re.fullmatch(r"(\w+://)?(.*)", file, flags=re.S).groups(default="")  # type: ignore[union-attr]
    beside = [
        posixpath.normpath(posixpath.join(posixpath.dirname(path), name.replace("\\", "/")))
        for name in names
        if ":" not in name and not name.startswith(("/", "\\"))
    ]
    return [scheme + path for path in beside if not path.startswith("..")]
