"""What the comparisons of imported robots share: the import, the cells of a table, and the table."""

import argparse
import contextlib
import json
import pathlib
import subprocess
import tempfile
import time
import tomllib

import plantd

ROOT = pathlib.Path(__file__).resolve().parents[2]


def arguments(doc, files):
    """Where the server and the binaries are, and files in place of the published ones."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--server", help="address of one that runs; by default one is started for the comparison")
    parser.add_argument("--binaries", type=pathlib.Path, default=ROOT / "target" / "release")
    parser.add_argument("--few", action="store_true", help="compare a choice, and write no table")
    parser.add_argument(files, nargs="*", type=pathlib.Path)
    return parser.parse_args()


@contextlib.contextmanager
def connected(options):
    """A client of the server that is named, or of one that lives as long."""
    if options.server:
        with plantd.connect(options.server) as client:
            yield client
        return
    with tempfile.TemporaryDirectory() as folder:
        ready = pathlib.Path(folder) / "ready.json"
        command = [options.binaries / "plantd", "serve", "--grpc", "127.0.0.1:0", "--ready-file", ready]
        with (pathlib.Path(folder) / "log").open("w+") as log:
            server = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
            try:
                deadline = time.monotonic() + 60
                while not ready.exists():
                    if server.poll() is not None or time.monotonic() > deadline:
                        log.seek(0)
                        raise SystemExit(f"the server did not start: {log.read()}")
                    time.sleep(0.01)
                with plantd.connect(json.loads(ready.read_text())["grpc"]) as client:
                    yield client
            finally:
                server.terminate()
                server.wait()


def imported(plantctl, file, *flags, without=()):
    """The scene of a robot without some of its sections, or the first reason against it."""
    run = [plantctl, "import", "--json", *flags, file]
    done = subprocess.run(run, capture_output=True, text=True, timeout=60)
    if done.returncode != 0:
        told = json.loads(done.stderr.splitlines()[-1])["error"]["message"]
        return None, told.removeprefix(f"{file} cannot be imported: ").splitlines()[0]
    scene = tomllib.loads(json.loads(done.stdout)["scene_toml"])
    for what in without:
        scene.pop(what, None)
    return scene, None


def cell(scene, refusal, compare, bars):
    """What a comparison of a scene has found, in words, and whether differences are below the bars."""
    if scene is None:
        return f"refused: {refusal}", True
    try:
        count, worst = compare(scene)
    except (plantd.PlantdError, ValueError, NotImplementedError) as error:
        return f"not compared: {error}".replace("\n", " "), False
    if worst is None:
        return "nothing moves", True
    is_good = all(value < bar for value, bar in zip(worst, bars))
    return f"{count}: {', '.join(f'{value:.0e}' for value in worst)}", is_good


def write(file, title, text, script, columns, rows):
    """Writes a table beside the importer."""
    lines = [f"# {title}", "", text, f"Made by `python3 tests/peers/{script}`.", ""]
    lines += [f"| {' | '.join(columns)} |".replace("|  |", "| |"), "| --- " * len(columns) + "|", *rows]
    (ROOT / "models/import" / file).write_text("\n".join(lines) + "\n")
