"""`svim3d view`: an asset, or a run while it goes on, in a browser on this machine.

What a run has is shown as it appears: the cameras with their pictures, the surface of each phase,
the asset. Files are looked at, nothing is computed but what showing them takes.
"""

import argparse
import contextlib
import functools
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from flows.run_records import RUNNING, RunIndex, RunRecord
from flows.runs import progress_of
from flows.stopping import interrupt_on_stop
from stages.errors import InputError
from stages.store import FILES_FOLDER, Store

if TYPE_CHECKING:  # an extra, and heavy
    import viser

DONE = 0
POLL_S = 1.0
ASSET = "asset.glb"
# What is shown of a run, in the order in which it comes about; the last one there is seen first.
LAYERS = {"nerf": "Surface of phase 1", "dmtet": "Surface of phase 2", "export": "Asset"}
CAMERAS = "Cameras"
FRUSTUM, FRAME = 0.1, 0.003  # world units; the object's longest side is 1
CLAY = (196, 188, 178)


def view(options: argparse.Namespace) -> int:
    """Show what is asked for until Ctrl-C.

    Raises:
        InputError: there is no such run or file, the viewer is not installed, or the port is not
            to be had.
    """
    watch = _watch(options.subject, options.store)
    if importlib.util.find_spec("viser") is None:
        raise InputError("svim3d view needs a package more: pip install 'svim3d[view]'")
    interrupt_on_stop()
    server = start_server(options.host, options.port)
    console = Console()
    shown = f"http://{options.host}:{server.get_port()}"
    console.print(f"{options.subject} is shown at {shown}; Ctrl-C ends it", highlight=False)
    try:
        scene = LiveScene(server)
        while True:
            watch(scene)
            time.sleep(POLL_S)
    except KeyboardInterrupt:
        return DONE
    finally:
        server.stop()


def start_server(host: str, port: int) -> "viser.ViserServer":
    """A viewer that browsers can open.

    Raises:
        InputError: it cannot listen there.
    """
    import viser

    try:
        server = viser.ViserServer(host=host, port=port, verbose=False)
    except (OSError, OverflowError) as error:
        raise InputError(f"cannot listen on {host}:{port}: {error}; try another --port") from error
    server.scene.set_up_direction("+y")
    server.initial_camera.position = (1.4, 1.1, 2.9)  # outside the orbit of the views
    server.initial_camera.look_at = (0.0, 0.0, 0.0)
    # One that the viewer brings along, dimmed: it shines beside the viewer's own lamps.
    server.scene.configure_environment_map("studio", environment_intensity=0.5)
    return server


def _watch(subject: str, store: Path) -> "Callable[[LiveScene], None]":
    """What to look at, again and again.

    Raises:
        InputError: there is no such thing.
    """
    file = Path(subject)
    if file.suffix.lower() == ".glb":
        if not file.is_file():
            raise InputError(f"there is no file {file}; check the path")
        return lambda scene: scene.show_file(file)
    if file.is_file():
        raise InputError(
            f"wanted a run or a .glb file, got {file}; svim3d export writes other formats"
        )
    index = RunIndex(store)
    first = index.find(subject)

    def show(scene: LiveScene) -> None:
        # The folder's newest run: it may have been started again meanwhile.
        with contextlib.suppress(InputError):
            scene.show_run(index.find(first.folder or first.id), Store(store))

    return show


class LiveScene:
    """The scene of one viewer; shows a thing once, and again when it has changed."""

    def __init__(self, server: "viser.ViserServer") -> None:
        self._server = server
        self._status = server.gui.add_markdown("")
        self._said = ""
        self._boxes: dict[str, Any] = {}
        self._handles: dict[str, list[Any]] = {}
        self._versions: dict[str, object] = {}

    def show_file(self, file: Path) -> None:
        """Show an asset, in its newest version."""
        with contextlib.suppress(OSError):  # being written at this moment
            version = file.stat().st_mtime_ns
            if self._is_new("export", version):
                content = file.read_bytes()
                self._put("export", lambda: [self._glb(content)])
                self._say(f"**{file.name}**, {file.stat().st_size / 2**20:.2f} MiB")

    def show_run(self, record: RunRecord, store: Store) -> None:
        """Show whatever a run has got, and how far it is."""
        state = record.now
        at_work = f", {record.stage} {progress_of(record)}" if state == RUNNING else ""
        error = f"\n\n{record.error}" if record.error else ""
        self._say(f"**{record.asset}**: {state}{at_work}{error}")
        for stage, show in (
            ("generation", self._cameras),
            ("nerf", self._field),
            ("dmtet", self._surface),
            ("export", self._asset),
        ):
            noted = record.stages.get(stage)
            key = noted.key if noted else None
            payload = store.artifact(key) / FILES_FOLDER if key else None
            if payload is not None and payload.is_dir() and self._is_new(stage, key):
                self._put(stage, functools.partial(show, payload))

    def _is_new(self, name: str, version: object) -> bool:
        return self._versions.get(name) != version and not self._versions.update({name: version})

    def _say(self, text: str) -> None:
        if text != self._said:
            self._status.content = self._said = text

    def _put(self, name: str, show: Callable[[], list[Any]]) -> None:
        """Take the place of an earlier version, and of what was in front so far."""
        for handle in self._handles.pop(name, ()):
            handle.remove()
        self._handles[name] = show()
        if name not in self._boxes:
            box = self._server.gui.add_checkbox(LAYERS.get(name, CAMERAS), initial_value=True)
            box.on_update(lambda _: self._obey())
            self._boxes[name] = box
        for other in LAYERS:
            if name in LAYERS and other in self._boxes:
                self._boxes[other].value = other == name
        self._obey()

    def _obey(self) -> None:
        """Show what is ticked."""
        for name, handles in self._handles.items():
            for handle in handles:
                handle.visible = self._boxes[name].value

    def _cameras(self, payload: Path) -> list[Any]:
        import viser.transforms

        from stages.live_scene import placed_pictures

        return [
            self._server.scene.add_camera_frustum(
                f"/views/{placed.view}",
                fov=placed.fov_y_rad,
                aspect=placed.picture.shape[1] / placed.picture.shape[0],
                scale=FRUSTUM,
                thickness=FRAME,
                image=placed.picture,
                wxyz=viser.transforms.SO3.from_matrix(placed.rotation).wxyz,
                position=placed.position,
            )
            for placed in placed_pictures(payload)
        ]

    def _field(self, payload: Path) -> list[Any]:
        from stages.live_scene import mesh_of_field

        return self._mesh("/phase 1", mesh_of_field(payload))

    def _surface(self, payload: Path) -> list[Any]:
        from stages.live_scene import mesh_of_surface

        return self._mesh("/phase 2", mesh_of_surface(payload))

    def _mesh(self, name: str, mesh: Any) -> list[Any]:
        """A surface in plain clay; nothing where it has no triangles."""
        if not len(mesh.faces):
            return []
        scene = self._server.scene
        return [scene.add_mesh_simple(name, mesh.vertices, mesh.faces, color=CLAY, side="double")]

    def _asset(self, payload: Path) -> list[Any]:
        return [self._glb((payload / ASSET).read_bytes())]

    def _glb(self, content: bytes) -> Any:
        return self._server.scene.add_glb("/asset", content)
