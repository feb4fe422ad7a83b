"""Puts the stubs of the contract into the wheel, and the contract itself into the source archive.

Where the variable PLANTD_BINARIES names a folder with the programs and libraries, as `wheel.py` does, the wheel has
them in it: `plantd` and `plantctl` as scripts, the library of FMUs, and the module behind `plantd.local`.
"""

import importlib.metadata
import os
import re
import sysconfig
import tempfile
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface


def contract(root: str) -> Path:
    """The folder with the .proto files: beside this one in a source archive, else the repository's."""
    for folder in (Path(root) / "proto", Path(root).parents[1] / "proto"):
        if (folder / "plantd" / "v1").is_dir():
            return folder
    raise FileNotFoundError("the .proto files of plantd.v1")


class StubsHook(BuildHookInterface):
    """Runs protoc into a temporary folder and adds what it wrote."""

    PLUGIN_NAME = "custom"

    def initialize(self, version, build_data):
        protos = contract(self.root)
        files = sorted(protos.glob("plantd/v1/*.proto"))
        if self.target_name == "sdist":
            for file in files:
                build_data["force_include"][str(file)] = f"proto/plantd/v1/{file.name}"
            return
        self._generated = tempfile.TemporaryDirectory()
        out = Path(self._generated.name)
        self._generate(protos, files, out)
        (out / "plantd" / "v1" / "__init__.py").write_text(
            '"""Messages and stubs of the contract, generated from plantd/v1/*.proto."""\n'
        )
        if os.environ.get("PLANTD_BINARIES"):
            self._add_binaries(Path(os.environ["PLANTD_BINARIES"]), build_data)
        # An editable installation finds them in the source tree, where git ignores them.
        for file in sorted(out.glob("plantd/v1/*")):
            if version == "editable":
                target = Path(self.root) / "src" / "plantd" / "v1" / file.name
                target.parent.mkdir(exist_ok=True)
                target.write_bytes(file.read_bytes())
            else:
                build_data["force_include"][str(file)] = f"plantd/v1/{file.name}"

    def finalize(self, version, build_data, artifact_path):
        if hasattr(self, "_generated"):
            self._generated.cleanup()

    @staticmethod
    def _add_binaries(folder: Path, build_data):
        build_data["pure_python"] = False
        platform = re.sub(r"[-.]", "_", sysconfig.get_platform())
        build_data["tag"] = f"cp310-abi3-{platform}"
        for program in ("plantd", "plantctl"):
            build_data["shared_scripts"][str(folder / program)] = program
        # Where `plantctl fmu` looks for it.
        build_data["shared_data"][str(folder / "libplantd_fmi.so")] = "lib/plantd/libplantd_fmi.so"
        build_data["force_include"][str(folder / "libplantd_python.so")] = "plantd/_native.abi3.so"

    @staticmethod
    def _generate(protos: Path, files: list, out: Path):
        from grpc_tools import protoc

        arguments = ["protoc", f"-I{protos}"]
        arguments += [f"--{kind}_out={out}" for kind in ("python", "pyi", "grpc_python")]
        if protoc.main(arguments + [str(file) for file in files]) != 0:
            raise RuntimeError("protoc failed")


class DependenciesHook(MetadataHookInterface):
    """Stubs run with the libraries that their generator was made with, or newer ones."""

    PLUGIN_NAME = "custom"

    def update(self, metadata):
        generator = importlib.metadata.requires("grpcio-tools") or []
        metadata["dependencies"] = ["numpy>=1.24", "googleapis-common-protos>=1.70"] + sorted(
            requirement for requirement in generator if re.match(r"(grpcio|protobuf)\b", requirement)
        )
