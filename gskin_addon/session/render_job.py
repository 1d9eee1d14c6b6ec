# SPDX-License-Identifier: GPL-3.0-or-later
"""One run of *Render Splats*: frames of the scene go to a process that draws them, its pictures to the output path."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ..core.errors import Cancelled, GSkinError, InputError
from ..core.files import read_arrays
from ..core.job.progress import ProgressEvent
from ..core.render.frame import Frame
from ..core.render.output import Output
from ..core.render.screen_space import camera_matrices, window_depths
from ..core.render.triangles import depth_of_triangles
from ..core.worker.frame_client import FrameClient
from ..core.worker.own_python import own_python
from ..scene.drawn import bare, read_drawn, rendered_splats
from ..scene.occluders import read_triangles
from ..scene.output_settings import frame_output, raw_output, write_with_blender
from ..scene.scene_camera import scene_camera


@dataclass
class RenderJob:
    """Frames to be drawn, one after the other; the scene is known by its name because undo makes it another object."""

    title = "Render Splats"

    client: FrameClient
    scene: str
    view_layer: str
    frames: Sequence[int]
    hold_out: bool
    depth: bool
    still: bool
    first_frame: int
    out: Path | None = None
    on_gpu: bool = False
    started: float = field(default_factory=time.monotonic)
    progress: ProgressEvent = field(default_factory=lambda: ProgressEvent("start", message="Starting"))
    cancelling: bool = False
    written: list[str] = field(default_factory=list)
    skipped: int = 0
    _next: int = 0
    _drawing: tuple[Output, Output] | None = None
    _folder: tempfile.TemporaryDirectory[str] = field(
        default_factory=lambda: tempfile.TemporaryDirectory(prefix="gskin-render-")
    )

    @classmethod
    def start(
        cls,
        scene: bpy.types.Scene,
        view_layer: bpy.types.ViewLayer,
        python: Path,
        *,
        animation: bool,
        hold_out: bool,
        depth: bool,
        frames: Sequence[int] | None = None,
        out: Path | None = None,
        on_gpu: bool = False,
    ) -> RenderJob:
        """Start the process that draws. animation: the scene's frames, else the present one; frames: these instead.

        out: the file of a still, in place of the output path's. on_gpu: by the 3D view's shader where it can be; needs
        a GPU context.

        Raises InputError where there is nothing to render, no camera, or no image format.
        """
        view_layer.update()  # what a script has just made is visible only then
        if not rendered_splats(view_layer):
            raise InputError("No splats are visible to renders; show a splat object and try again.")
        scene_camera(scene, view_layer.depsgraph)
        frame_output(scene, scene.frame_current, depth=depth)
        if frames is None:
            every = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
            frames = list(every) if animation else [scene.frame_current]
        client = FrameClient(python, isolated=python == own_python(), gentle=not bpy.app.background)
        return cls(
            client, scene.name, view_layer.name, frames, hold_out, depth, not animation, scene.frame_current,
            out, on_gpu,
        )  # fmt: skip

    @property
    def pictures(self) -> None:
        """None: its frames are in the output folder."""

    @property
    def seconds_left(self) -> float | None:
        """By what the frames took so far."""
        done = len(self.written)
        left = len(self.frames) - self._next + (self._drawing is not None)
        return None if done == 0 else (time.monotonic() - self.started) / done * left

    def step(self) -> bool:
        """Take in what was drawn and hand out the next frame; True while there is something to do.

        Waits for nothing but Blender's own evaluation of a frame.

        Raises:
            GSkinError: drawing or writing failed. Cancelled: it was asked to stop.
        """
        if self.cancelling:
            raise Cancelled("Rendering was cancelled.")
        for line in self.client.poll():
            if line["stage"] == "drawn":
                self._keep()
            elif line["stage"] == "compiling":
                self.progress = ProgressEvent("render", 0.0, None, message="Compiling what draws, once")
            else:
                self._tell(float(line["fraction"]))
        while self._drawing is None and self._next < len(self.frames):
            self._begin(self.frames[self._next])
            self._next += 1
        return self._drawing is not None

    def wait(self, show: Callable[[ProgressEvent], None]) -> None:
        """Render to the end; for programs without a window."""
        while self.step():
            show(self.progress)
            time.sleep(0.02)

    def cancel(self) -> None:
        """Stop; nothing is drawn any more. Never waits."""
        self.cancelling = True
        self.client.stop()

    def close(self) -> str:
        """End the process, give the scene its frame back; returns a sentence about what was written."""
        self.client.stop()
        if self._drawing is not None:
            _remove_placeholder(self._drawing[0])
            self._drawing = None
        self._folder.cleanup()
        scene: bpy.types.Scene | None = bpy.data.scenes.get(self.scene)
        if scene is not None and not self.still and scene.frame_current != self.first_frame:
            scene.frame_set(self.first_frame)
        seconds = time.monotonic() - self.started
        skipped = f"; {self.skipped} were there already" if self.skipped else ""
        if not self.written:
            return f"Nothing was rendered{skipped}"
        count = "" if len(self.written) == 1 else f"{len(self.written)} frames up to "
        by = ", by the processor, as the graphics card tells no depth" if self.on_gpu and self.depth else ""
        return f"Splats rendered: {count}'{self.written[-1]}' ({seconds:.1f} s{by}){skipped}"

    def _begin(self, number: int) -> None:
        scene, view_layer = self._scene()
        output = frame_output(scene, number, depth=self.depth, path=self.out)
        path = Path(output.path)
        if not self.still and not scene.render.use_overwrite and path.exists():
            self.skipped += 1
            return
        _make_folder(path)
        if not self.still and scene.render.use_placeholder and not path.exists():
            path.touch()
        frame = self._read(scene, view_layer, number)
        sent = raw_output(output, Path(self._folder.name)) if output.form == "raw" else output
        self.client.draw(number, frame, sent)
        self._drawing = output, sent
        self._tell(0.0)

    def _read(self, scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, number: int) -> Frame:
        splats = rendered_splats(view_layer)
        with bare(splats):
            if not self.still and number != scene.frame_current:
                scene.frame_set(number)
            view_layer.update()
            depsgraph = view_layer.depsgraph
            camera, far = scene_camera(scene, depsgraph)
            drawn = [read_drawn(obj, depsgraph) for obj in splats]
            triangles = read_triangles(depsgraph, splats if self.hold_out else list(view_layer.objects))
        frame = Frame(drawn, camera, triangles, far)
        return drawn_by_shader(frame) if self.on_gpu and not self.depth else frame

    def _keep(self) -> None:
        """The process has written the frame in hand."""
        if self._drawing is None:
            return
        output, sent = self._drawing
        if output.form == "raw":
            scene, _ = self._scene()
            write_with_blender(read_arrays(Path(sent.path), ["rgba"])["rgba"], output, scene)
        self.written.append(output.path)
        self._drawing = None

    def _tell(self, share: float) -> None:
        number = self._next if self._drawing is None else max(self._next, 1)
        fraction = min(1.0, (max(number - 1, 0) + share) / max(len(self.frames), 1))
        message = f"Frame {self.frames[max(number - 1, 0)]} ({number} of {len(self.frames)})"
        self.progress = ProgressEvent("render", fraction, self.seconds_left, message=message)

    def _scene(self) -> tuple[bpy.types.Scene, bpy.types.ViewLayer]:
        scene: bpy.types.Scene | None = bpy.data.scenes.get(self.scene)
        view_layer = None if scene is None else scene.view_layers.get(self.view_layer)
        if scene is None or view_layer is None:
            raise InputError(f"The scene '{self.scene}' was renamed or deleted while it was rendered; start again.")
        return scene, view_layer


def drawn_by_shader(frame: Frame) -> Frame:
    """The frame as drawn by the 3D view's shader; the other process has only to write it. Needs a GPU context."""
    from ..scene.viewport.drawing import draw_splats

    camera = frame.camera
    view, projection = camera_matrices(camera, frame.far)
    hiding = None
    if len(frame.triangles):
        hiding = window_depths(depth_of_triangles(frame.triangles, camera), projection)
    picture = draw_splats(frame.objects, view, projection, camera.width, camera.height, depth=hiding)
    return Frame([], camera, frame.triangles, frame.far, picture)


def _make_folder(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GSkinError(
            f"The output folder '{path.parent}' cannot be made ({error.strerror}); choose another in the Output "
            "properties."
        ) from error


def _remove_placeholder(output: Output) -> None:
    path = Path(output.path)
    with contextlib.suppress(OSError):
        if path.stat().st_size == 0:
            path.unlink()
