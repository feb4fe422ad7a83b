"""Makes the files of a release, of the version in `Cargo.toml`, into `target/release-files`.

    python3 deploy/release.py            # a release build, and everything below
    python3 deploy/release.py --check    # whether a release can be made; builds nothing

| file | what |
| --- | --- |
| `plantd-VERSION-*.whl` | the Python package with the programs in it |
| `plantd-VERSION-TARGET.tar.gz` | programs, manual pages, completions, the library of FMUs, files of deployment; `cargo binstall` takes it |
| `libplantd-VERSION-TARGET.tar.gz` | the library for C and C++, with its headers |
| `Containerfile` | how the image is built, from the sources of that version |
| `plantd-VERSION.cdx.json` | what it is made of: an SBOM in CycloneDX 1.5 |
| `CHANGES.md` | the section of the changelog |
| `SHA256SUMS` | checksums of all of them |

It needs what `client/python/wheel.py` needs. The same commit and tools make the same archives.
"""

import argparse
import gzip
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import uuid
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("plantd-server", "plantd-client", "plantd-fmi", "plantd-python", "plantd-link-c")
#: What the programs of a release have besides what is always there.
FEATURES = "plantd-server/object-store"
#: Packages with programs, and the programs.
PROGRAMS = {"server": "plantd", "client": "plantctl"}
#: What the archive of programs has beside them.
BESIDE = ("README.md", "CHANGELOG.md", "LICENSE-APACHE", "LICENSE-MIT", "SECURITY.md")
DEPLOYED = ("plantd.service", "plantd.sysusers", "plantd.toml", "prometheus.yml", "alerts.yml", "grafana.json")
SHELLS = {"bash": "plantctl", "zsh": "_plantctl", "fish": "plantctl.fish"}


def run(*command: str | os.PathLike[str], **options) -> subprocess.CompletedProcess[str]:
    print("$", *command, flush=True)
    return subprocess.run([os.fspath(word) for word in command], check=True, cwd=ROOT, text=True, **options)


def told(*command: str) -> str:
    return subprocess.run(command, check=True, cwd=ROOT, text=True, stdout=subprocess.PIPE).stdout


def manifest(path: str) -> dict:
    return tomllib.loads((ROOT / path).read_text())


def version() -> str:
    """The version, which every package has to have."""
    found = manifest("Cargo.toml")["workspace"]["package"]["version"]
    others = {"client/python/pyproject.toml": manifest("client/python/pyproject.toml")["project"]["version"]}
    for package in ("client/viewer/package.json", "client/node/package.json"):
        others[package] = json.loads((ROOT / package).read_text())["version"]
    for file, other in others.items():
        if other != found:
            sys.exit(f"{file} has version {other}; Cargo.toml has {found}")
    return found


def changes(number: str) -> str:
    """The section of the changelog."""
    text = (ROOT / "CHANGELOG.md").read_text()
    section = re.search(rf"^## \[{re.escape(number)}\].*?\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    if section is None or not section[1].strip():
        sys.exit(f"CHANGELOG.md has no section {number}")
    return section[1].strip() + "\n"


def target() -> str:
    """The platform, as Rust calls it."""
    return re.search(r"^host: (.*)$", told("rustc", "-vV"), re.M)[1]


def check_binstall(number: str, triple: str) -> None:
    """That `cargo binstall` finds the archive under the name that it gets, and the programs in it."""
    folder = f"plantd-{number}-{triple}"
    for package, program in PROGRAMS.items():
        metadata = manifest(f"{package}/Cargo.toml")["package"]["metadata"]["binstall"]
        values = {"version": number, "target": triple, "bin": program, "binary-ext": ""}
        fill = lambda text: re.sub(r"\{ ([a-z-]+) \}", lambda key: values.get(key[1], key[0]), text)
        if not fill(metadata["pkg-url"]).endswith(f"/v{number}/{folder}.tar.gz"):
            sys.exit(f"{package}/Cargo.toml: binstall looks for {fill(metadata['pkg-url'])}")
        if fill(metadata["bin-dir"]) != f"{folder}/bin/{program}":
            sys.exit(f"{package}/Cargo.toml: binstall looks for {fill(metadata['bin-dir'])}")


def sbom(number: str, time: int) -> dict:
    """What the programs and libraries are made of, in CycloneDX: packages of Rust, and of the page's bundle."""
    tree = json.loads(told("cargo", "metadata", "--format-version=1", "--locked", f"--filter-platform={target()}"))
    packages = {package["id"]: package for package in tree["packages"]}
    # What is linked: neither tests nor what only builds use.
    edges = {
        node["id"]: [
            dep["pkg"] for dep in node["deps"] if any(kind["kind"] is None for kind in dep["dep_kinds"])
        ]
        for node in tree["resolve"]["nodes"]
    }
    found, open_ids = set(), [id for id, package in packages.items() if package["name"] in PACKAGES]
    while open_ids:
        id = open_ids.pop()
        if id not in found:
            found.add(id)
            open_ids += edges[id]
    locked = {(p["name"], p["version"]): p.get("checksum") for p in manifest("Cargo.lock")["package"]}

    def of_rust(package: dict) -> dict:
        name, exact = package["name"], package["version"]
        purl = f"pkg:cargo/{name}@{exact}"
        component = {"type": "library", "bom-ref": purl, "name": name, "version": exact, "purl": purl}
        if package["license"]:
            component["licenses"] = [{"expression": package["license"].replace("/", " OR ")}]
        if checksum := locked.get((name, exact)):
            component["hashes"] = [{"alg": "SHA-256", "content": checksum}]
        return component

    def of_page(path: str, package: dict) -> dict:
        name = path.removeprefix("node_modules/")
        purl = f"pkg:npm/{name.replace('@', '%40')}@{package['version']}"
        component = {"type": "library", "bom-ref": purl, "name": name, "version": package["version"], "purl": purl}
        if package.get("license"):
            component["licenses"] = [{"expression": package["license"]}]
        return component

    page = json.loads((ROOT / "client/viewer/package-lock.json").read_text())["packages"].items()
    components = [of_rust(packages[id]) for id in sorted(found, key=lambda id: packages[id]["name"])]
    components += [of_page(path, package) for path, package in page if path and not package.get("dev")]
    refs = {id: f"pkg:cargo/{packages[id]['name']}@{packages[id]['version']}" for id in found}
    depend = lambda id: sorted({refs[other] for other in edges[id] if other in found})
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, f'plantd {number} {time}')}",
        "version": 1,
        "metadata": {"component": {"type": "application", "bom-ref": "plantd", "name": "plantd", "version": number}},
        "components": components,
        "dependencies": [{"ref": refs[id], "dependsOn": depend(id)} for id in sorted(found, key=refs.get)],
    }


def pack(folder: Path, archive: Path, time: int) -> None:
    """An archive whose bytes depend on what is in it alone."""

    def plain(entry: tarfile.TarInfo) -> tarfile.TarInfo:
        entry.uid = entry.gid = 0
        entry.uname = entry.gname = "root"
        entry.mtime = time
        entry.mode = 0o755 if entry.isdir() or entry.mode & 0o100 else 0o644
        return entry

    with gzip.GzipFile(archive, "wb", mtime=time) as packed, tarfile.open(fileobj=packed, mode="w") as tar:
        tar.add(folder, arcname=folder.name, recursive=False, filter=plain)
        for path in sorted(folder.rglob("*")):
            tar.add(path, arcname=path.relative_to(folder.parent), recursive=False, filter=plain)


def stripped(binaries: Path, name: str, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    run("strip", "--strip-unneeded", "-o", folder / name, binaries / name)
    return folder / name


def programs(binaries: Path, folder: Path) -> None:
    """The tree of the archive of programs: an installation's, below any prefix."""
    for program in PROGRAMS.values():
        stripped(binaries, program, folder / "bin")
    # Where `plantctl fmu` looks for it.
    stripped(binaries, "libplantd_fmi.so", folder / "lib/plantd")
    plantctl = folder / "bin/plantctl"
    run(plantctl, "man", folder / "share/man", "--quiet")
    for shell, name in SHELLS.items():
        script = run(plantctl, "completions", shell, stdout=subprocess.PIPE).stdout
        file = folder / "share/completions" / shell / name
        file.parent.mkdir(parents=True)
        file.write_text(script)
    for name in BESIDE:
        shutil.copy(ROOT / name, folder)
    for name in DEPLOYED:
        (folder / "deploy").mkdir(exist_ok=True)
        shutil.copy(ROOT / "deploy" / name, folder / "deploy")


def make(binaries: Path, output: Path, number: str, triple: str, time: int) -> None:
    output.mkdir(parents=True, exist_ok=True)
    for file in output.iterdir():
        file.unlink()
    with tempfile.TemporaryDirectory(prefix="plantd-release-") as name:
        scratch = Path(name)
        folder = scratch / f"plantd-{number}-{triple}"
        programs(binaries, folder)
        pack(folder, output / f"{folder.name}.tar.gz", time)
        library = scratch / f"libplantd-{number}-{triple}"
        run(ROOT / "client/c/install.sh", library, binaries)
        run("strip", "--strip-unneeded", library / f"lib/libplantd.so.{number}")
        run("strip", "--strip-debug", library / "lib/libplantd.a")
        for name in ("LICENSE-APACHE", "LICENSE-MIT"):
            shutil.copy(ROOT / name, library)
        pack(library, output / f"{library.name}.tar.gz", time)
    run(sys.executable, ROOT / "client/python/wheel.py", "--binaries", binaries, "--output", output)
    shutil.copy(ROOT / "deploy/Containerfile", output)
    (output / f"plantd-{number}.cdx.json").write_text(json.dumps(sbom(number, time), indent=1) + "\n")
    (output / "CHANGES.md").write_text(changes(number))
    files = sorted(file for file in output.iterdir() if file.name != "SHA256SUMS")
    sums = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n" for file in files]
    (output / "SHA256SUMS").write_text("".join(sums))
    for file in files:
        print(f"{file.stat().st_size / 1e6:8.2f} MB  {file.name}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    built = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    parser.add_argument("--check", action="store_true", help="say whether a release can be made")
    parser.add_argument("--binaries", type=Path, metavar="FOLDER", help="take what is built there")
    parser.add_argument("--output", type=Path, default=built / "release-files", metavar="FOLDER")
    arguments = parser.parse_args()
    number, triple = version(), target()
    time = int(told("git", "log", "-1", "--format=%ct"))
    changes(number)
    check_binstall(number, triple)
    if arguments.check:
        components = sbom(number, time)["components"]
        print(f"plantd {number} for {triple}: {len(components)} components")
        return
    if arguments.binaries is None:
        if told("git", "status", "--porcelain").strip():
            sys.exit("there are changes that are not committed: a release is made of a commit")
        words = [word for package in PACKAGES for word in ("-p", package)]
        run("cargo", "build", "--release", "--locked", *words, "--features", FEATURES)
    binaries = arguments.binaries or built / "release"
    make(binaries.resolve(), arguments.output.resolve(), number, triple, time)


if __name__ == "__main__":
    main()
