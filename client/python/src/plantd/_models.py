"""Models: scenes and robots on the server, and where they rest."""

from __future__ import annotations

import posixpath
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from plantd.v1 import model_service_pb2

from . import _meshes
from ._arrays import Array, Vector, array, vector
from ._calls import Calls
from ._check import build, mapping, shown, texts
from ._errors import PlantdError


@dataclass(frozen=True, eq=False)
class Settled:
    """A configuration on the constraints; of an equilibrium also what holds it."""

    q: Array
    #: Input: forces, then the prescribed positions of ``q``.
    u: Array
    #: Potential energy, J; None if only the constraints were asked for, as all that follows.
    potential: float | None = None
    #: Largest force that remains on a coordinate, N or N m.
    residual: float | None = None
    #: Constraint forces that hold it.
    constraint_forces: Array | None = None
    #: A minimum of the potential energy, held coordinates apart.
    stable: bool | None = None
    #: Smallest eigenvalue of the stiffness on the constraints, N/m or N m/rad.
    smallest_stiffness: float | None = None

    @classmethod
    def _from(cls, m: model_service_pb2.SettleResponse) -> Settled:
        q, u = array(m.q), array(m.u)
        if not m.HasField("equilibrium"):
            return cls(q, u)
        e = m.equilibrium
        forces = array(e.constraint_forces)
        return cls(q, u, e.potential_j, e.residual, forces, e.stable, e.smallest_stiffness)


def is_file(scene: str | PathLike[str]) -> bool:
    """Whether it is not a text: one that has several lines or begins as JSON or XML."""
    return not isinstance(scene, str) or not (
        "\n" in scene or scene.lstrip().startswith(("{", "<"))
    )


def scene_text(scene: str | PathLike[str]) -> str:
    """The text of a scene: itself, or a file's."""
    if not isinstance(scene, (str, PathLike)):
        raise TypeError(f"`scene` is {shown(scene)}; a text or a path is needed")
    if not is_file(scene):
        return str(scene)
    path = Path(scene)
    text = path.read_text(encoding="utf-8")
    return _with_includes(text, path.parent, [path.name]) if "<mujoco" in text else text


def _with_includes(text: str, folder: Path, seen: list[str]) -> str:
    """An MJCF in which each ``include`` is replaced by what is in the root of its file."""
    text = re.sub(r"<!--.*?-->", lambda comment: "\n" * comment[0].count("\n"), text, flags=re.S)

    def included(element: re.Match[str]) -> str:
        name = element[1]
        if name in seen:
            raise ValueError(f"`{name}` is included twice; once is allowed")
        seen.append(name)
        inner = _with_includes((folder / name).read_text(encoding="utf-8"), folder, seen)
        root = re.search(r"<mujoco[^>]*?(?:/>|>(.*)</mujoco)", inner, flags=re.S)
        if root is None:
            raise ValueError(f"`{name}` is no MJCF: its root must be `mujoco` or `mujocoinclude`")
        return root[1] or ""

    return re.sub(r"""<include\s+file=["']([^"']*)["']\s*(?:/>|>\s*</include>)""", included, text)


#: Models that are attached to one another at most, as the importer has it.
_DEPTH = 32


def _mesh_files(scene: str | PathLike[str], text: str) -> dict[str, Path]:
    """Files of the meshes of an MJCF, and models that it attaches, by their paths as the importer names them."""
    if not is_file(scene) or "<mujoco" not in text:
        return {}
    names: dict[str, None] = {}
    _name_files(text, Path(scene).parent, "", names)
    return {path: Path(scene).parent / path for path in names}


def _name_files(text: str, folder: Path, base: str, names: dict[str, None], depth: int = 0) -> None:
    """Adds the files that a model names, which stands in ``base``, and those of the models that it attaches."""
    found = {kind: path for kind, path in re.findall(r"""\b(meshdir|assetdir)=["']([^"']*)""", text)}
    meshes = found.get("meshdir", found.get("assetdir", "")).rstrip("/")
    meshes = meshes if meshes.startswith("/") else posixpath.join(base, meshes)
    for name in re.findall(r"""<mesh\b[^>]*?\bfile=["']([^"']+)["']""", text):
        names.setdefault(posixpath.join(meshes, name))
    if "<attach" not in text or depth == _DEPTH:
        return
    for name in re.findall(r"""<model\b[^>]*?\bfile=["']([^"']+)["']""", text):
        path = posixpath.join(base, name)
        if path not in names and (folder / path).is_file():
            names.setdefault(path)
            inner = (folder / path).read_text(encoding="utf-8")
            _name_files(inner, folder, posixpath.dirname(path), names, depth + 1)


def _missing(problems: str, files: Mapping[str, Path], known: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files that a refusal names and that are there, but were not sent."""

    def is_asked(file: str) -> bool:
        is_model = file.endswith(".xml") and "`attach`" in problems
        return is_model or any(words in problems for words in (f"mesh file `{file}`", f"`{file}` cannot be read"))

    return {
        file: place.read_bytes()
        for file, place in files.items()
        if file not in known and is_asked(file) and place.is_file()
    }


class ModelCalls(Calls):
    """Calls of the service of models."""

    def list_models(self) -> list[model_service_pb2.Model]:
        """All models, built-in ones first."""
        models, token = [], ""
        while True:
            request = build(model_service_pb2.ListModelsRequest, page_token=token)
            page = self._call(self.models.ListModels, request)
            models.extend(page.models)
            token = page.next_page_token
            if not token:
                return models

    def get_model(self, name: str) -> model_service_pb2.Model:
        """A model: coordinates, inputs, constraints, operating points, scene and plan."""
        request = build(model_service_pb2.GetModelRequest, name=name)
        answer: model_service_pb2.GetModelResponse = self._call(self.models.GetModel, request)
        return answer.model

    def create_model(
        self,
        scene: str | PathLike[str],
        *,
        name: str = "",
        replace: bool = False,
        packages: Mapping[str, str | PathLike[str]] | None = None,
    ) -> model_service_pb2.Model:
        """Uploads a scene (TOML, JSON) or a robot (URDF, MJCF): a text of several lines, or a file.

        All errors are in the error's ``violations``. What a robot says and a scene cannot is a
        ``UserWarning`` with lines and columns; what has no effect on the motion is not mentioned.
        ``replace`` puts it in the place of an uploaded model of that name, whose plants live on.
        Meshes from which an MJCF in a file takes inertia are read beside it.
        The meshes that show what is in a file are sent along where they are found: beside it, or in
        the folders of ``packages`` by name, or in folders of these names around it. One that is not
        found, or not taken, is a ``UserWarning``.
        """
        request = build(
            model_service_pb2.CreateModelRequest,
            scene=scene_text(scene),
            name=name,
            replace=replace,
        )
        meshes = _mesh_files(scene, request.scene)
        answer: model_service_pb2.CreateModelResponse
        while True:
            try:
                answer = self._call(self.models.CreateModel, request)
                break
            except PlantdError as error:
                # Only the importer knows which of them weigh something.
                news = _missing(str(error), meshes, request.files)
                if not news:
                    raise
                request.files.update(news)
        told = [
            f"{note.line}:{note.column}: {note.message}"
            for note in answer.import_report.notes
            if note.kind != model_service_pb2.IMPORT_KIND_NO_EFFECT
        ]
        if told:
            warnings.warn("\n".join([f"{answer.model.name}:", *told]), stacklevel=2)
        if is_file(scene):
            folders = mapping("packages", packages, "{'panda_description': '/opt/panda'}")
            missing = self._put_meshes(answer.model.name, Path(scene).parent, folders)
            if missing:
                warnings.warn("\n".join([f"{answer.model.name}:", *missing]), stacklevel=2)
        return answer.model

    def _put_meshes(
        self, model: str, folder: Path, packages: Mapping[str, str | PathLike[str]]
    ) -> list[str]:
        """Sends the meshes of a model that the server has not; says which could not be sent, and why."""
        shapes = [
            shape for frame in self.get_drawing(model=model).drawing.frames for shape in frame.shapes
        ]
        files = {s.mesh.file for s in shapes if s.HasField("mesh") and not s.mesh.url}
        missing = []
        for file, data in _meshes.find(files, folder, packages):
            if data is None:
                missing.append(f"mesh `{file}` was not found")
                continue
            try:
                self.put_model_file(model, file, data)
            except PlantdError as error:
                missing.append(f"mesh `{file}` was not taken: {error}")
        return missing

    def put_model_file(self, model: str, file: str, data: bytes) -> str:
        """Gives an uploaded model a file that its visuals name; where browsers find it, a path on the
        server's address."""
        request = build(model_service_pb2.PutModelFileRequest, model=model, file=file, data=data)
        answer: model_service_pb2.PutModelFileResponse
        answer = self._call(self.models.PutModelFile, request)
        return answer.url

    def get_drawing(
        self, plant: str | None = None, *, model: str | None = None
    ) -> model_service_pb2.GetDrawingResponse:
        """What a viewer draws of a plant, or of a model: frames with shapes, lines, arrows."""
        request = build(model_service_pb2.GetDrawingRequest, plant=plant, model=model)
        answer: model_service_pb2.GetDrawingResponse = self._call(self.models.GetDrawing, request)
        return answer

    def validate_scene(
        self, scene: str | PathLike[str]
    ) -> list[model_service_pb2.SceneProblem]:
        """All errors of a scene or robot, a text of several lines or a file; none when it is good."""
        request = build(model_service_pb2.ValidateSceneRequest, scene=scene_text(scene))
        meshes = _mesh_files(scene, request.scene)
        while True:
            problems = list(self._call(self.models.ValidateScene, request).problems)
            news = _missing("\n".join(p.message for p in problems), meshes, request.files)
            if not news:
                return problems
            request.files.update(news)

    def settle(
        self,
        model: str,
        *,
        q: Vector = (),
        guess: Mapping[str, float] | None = None,
        hold: Sequence[str] = (),
        inputs: Mapping[str, float] | None = None,
        targets: Mapping[str, Vector] | None = None,
        constraints_only: bool = False,
    ) -> Settled:
        """Finds a configuration in which the model rests, from a guess.

        The guess is ``q``, or the scene's initial configuration, with the values of ``guess`` put in;
        coordinates in ``hold`` keep their value of it. ``inputs`` are the forces that act.
        ``constraints_only`` finds a configuration close to the guess that satisfies the constraints.
        ``targets`` say where the origins of frames shall be in the world, three numbers each, or seven with
        the orientation as a unit quaternion w, x, y, z: inverse kinematics.
        """
        goal = "SETTLE_GOAL_CONSTRAINTS" if constraints_only else "SETTLE_GOAL_EQUILIBRIUM"
        request = build(
            model_service_pb2.SettleRequest,
            model=model,
            q=vector(q, "q"),
            guess=mapping("guess", guess, "{'theta': 0.5}"),
            hold=texts("hold", hold),
            inputs=mapping("inputs", inputs, "{'force': 1.0}"),
            goal=model_service_pb2.SettleGoal.Value(goal),
        )
        for frame, target in mapping("targets", targets, "{'hand': [0.4, 0.0, 0.5]}").items():
            numbers = vector(target, "target")
            request.targets.add(
                point={"frame": frame}, position=numbers[:3], orientation=numbers[3:]
            )
        return Settled._from(self._call(self.models.Settle, request))

    def delete_model(self, name: str) -> None:
        """Forgets an uploaded model; its plants live on."""
        self._call(self.models.DeleteModel, build(model_service_pb2.DeleteModelRequest, name=name))
