# SPDX-License-Identifier: GPL-3.0-or-later
"""A story played inside a running Blender window: steps that wait without blocking, a heartbeat, keys, pictures."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, NamedTuple

import bpy
from pace import Pace

BEAT = 0.02
"""Seconds between two beats of the heart: Blender's event loop calls it unless something holds the loop up."""
PAUSE = 0.5
"""Seconds that Blender's main thread may be busy at a time, whatever is done."""

Wait = float | Callable[[], Any]
Story = Generator[Wait, None, None]


class Beat(NamedTuple):
    """When, in which chapter, and what the main thread had taken and waited for by then: seconds of processor time, and
    seconds in which it could have run but had no processor, because others had them all."""

    at: float
    chapter: str
    busy: float
    waited: float


class Stage:
    """Runs a story from Blender's timers, and writes what came of it to `out`/result.json."""

    def __init__(self, out: Path, patience: float = 300.0) -> None:
        self.out, self.patience = out, patience
        self.pace = Pace(out / "pace.txt")
        self.checks: list[tuple[str, bool, str]] = []
        self.numbers: dict[str, float] = {}
        self.views: dict[str, tuple[int, int, int, int]] = {}
        self.beats: list[Beat] = []
        self.chapter = ""
        self.redraws: Counter[str] = Counter()
        self._story: Story | None = None
        self._wait: Wait = 0.0
        self._since = time.monotonic()

    def play(self, story: Story) -> None:
        """Start; returns at once."""
        self._story = story
        bpy.types.SpaceView3D.draw_handler_add(self._redrawn, (), "WINDOW", "PRE_VIEW")
        bpy.app.timers.register(self._beat, first_interval=0.5, persistent=True)

    def check(self, what: str, good: Any, seen: Any = "") -> None:
        """Note whether something is as it should be; the story goes on either way."""
        self.checks.append((what, bool(good), str(seen)))
        print(f"{'ok  ' if good else 'FAIL'} {what}" + (f": {seen}" if str(seen) else ""), flush=True)

    def attempt(self, what: str, story: Story) -> Story:
        """Play a part of a story; where it raises, that is noted, and the rest goes on."""
        try:
            yield from story
        except Exception as error:
            traceback.print_exc()
            self.check(f"{what} runs to its end", False, f"{type(error).__name__}: {error}")

    def check_time(self, what: str, seconds: float, bar: float, pace: float) -> None:
        """Note whether something took no longer than `bar` seconds of a quiet machine, at the pace of its time."""
        self.check(what, seconds <= bar * pace, f"{seconds:.3f} s; {bar:g} s at pace {pace:.1f}")

    def pause(self, seconds: float) -> Wait:
        """A wait as long as `seconds` of a quiet machine."""
        began = time.monotonic()
        return lambda: time.monotonic() - began >= seconds * self.pace.mean(began)

    def soon(self, condition: Callable[[], Any], seconds: float = 20.0) -> Wait:
        """Wait until something is so, at most `seconds` of a quiet machine; what follows looks whether it is."""
        over = self.pause(seconds)
        return lambda: condition() or over()

    def chapter_times(self, chapter: str) -> tuple[float, float]:
        """The first and the last beat of a chapter; zeros where it had none."""
        times = [beat.at for beat in self.beats if beat.chapter == chapter]
        return (times[0], times[-1]) if times else (0.0, 0.0)

    def gaps(self, chapter: str) -> list[float]:
        """Seconds between beats of which the later one fell in `chapter`."""
        return [late.at - early.at for early, late in self._pairs(chapter)]

    def own_gaps(self, chapter: str) -> list[float]:
        """The same without the time in which the main thread could have gone on, had others left it a processor."""
        return [late.at - early.at - (late.waited - early.waited) for early, late in self._pairs(chapter)]

    def busy(self, chapter: str) -> list[float]:
        """Seconds of processor time that Blender's main thread took between the same beats."""
        return [late.busy - early.busy for early, late in self._pairs(chapter)]

    def note_pauses(self, chapter: str, what: str, *, ours: bool = False) -> None:
        """Note how long Blender stood still in a chapter at most: by the clock, but for what others took, and busy.

        ours: that it is our own work, which has a bar; modes and strokes are Blender's, and that of drawing without a
        graphics card.
        """
        self.numbers[f"{what}: longest pause s"] = max(self.own_gaps(chapter), default=0.0)
        busy = self.numbers[f"{what}: longest busy s"] = max(self.busy(chapter), default=0.0)
        if ours:
            self.check_time(f"{what}: no long pause", busy, PAUSE, self.pace.busy(*self.chapter_times(chapter)))

    def _pairs(self, chapter: str) -> list[tuple[Beat, Beat]]:
        return [pair for pair in zip(self.beats, self.beats[1:], strict=False) if pair[1].chapter == chapter]

    def _redrawn(self) -> None:
        self.redraws[self.chapter] += 1

    def _beat(self) -> float | None:
        self.beats.append(Beat(time.monotonic(), self.chapter, time.thread_time(), waited()))
        try:
            while self._ready():
                self._wait = next(self._story)
                self._since = time.monotonic()
        except StopIteration:
            self._end()
            return None
        except Exception:
            traceback.print_exc()
            self.check("the story runs to its end", False, traceback.format_exc(limit=1).splitlines()[-1])
            self._end()
            return None
        return BEAT

    def _ready(self) -> bool:
        waited = time.monotonic() - self._since
        if isinstance(self._wait, int | float):
            return waited >= self._wait
        if self._wait():
            return True
        if waited > self.patience * self.pace.mean(self._since):
            raise TimeoutError(f"waited {waited:.0f} s in chapter '{self.chapter}'")
        return False

    def _end(self) -> None:
        self.pace.stop()
        result = {"checks": self.checks, "numbers": self.numbers, "views": self.views}
        (self.out / "result.json").write_text(json.dumps(result, indent=1))
        bpy.ops.wm.quit_blender()


def story_parser() -> argparse.ArgumentParser:
    """Of the arguments behind `--` that every story has: where its pictures go, and the splats."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--splats", type=Path, required=True)
    return parser


def perform(story: Callable[[Stage, argparse.Namespace], Story], parser: argparse.ArgumentParser) -> None:
    """Read the arguments behind `--` and start the story."""
    options = parser.parse_args(sys.argv[sys.argv.index("--") + 1 :])
    bpy.context.preferences.view.show_splash = False
    stage = Stage(options.out)
    stage.play(story(stage, options))


def waited() -> float:
    """Seconds for which this thread has waited for a processor so far; 0 where the system does not tell."""
    try:
        return int(Path("/proc/thread-self/schedstat").read_text().split()[1]) / 1e9
    except (OSError, IndexError, ValueError):
        return 0.0


class Hands:
    """The mouse, the keyboard and a camera, outside of Blender. `views` gets where each picture has its 3D view."""

    def __init__(self, out: Path, view: View, views: dict[str, tuple[int, int, int, int]]) -> None:
        self.out, self.view, self.views = out, view, views
        self.pressed = self.released = 0.0
        """When the last stroke began, and when the last doing of the hands ended."""

    def keys(self, *names: str) -> Story:
        """Press keys by their X names, one after the other."""
        yield from self._run("xdotool", "key", "--delay", "60", *names)

    def text(self, words: str) -> Story:
        """Type."""
        yield from self._run("xdotool", "type", "--delay", "40", words)

    def move(self, x: int, y: int) -> Story:
        """Move the mouse; y counts from the top, as X does."""
        yield from self._run("xdotool", "mousemove", str(x), str(y))

    def click(self, x: int, y: int) -> Story:
        """Move there and press the left button."""
        yield from self._run("xdotool", "mousemove", str(x), str(y), "sleep", "0.15", "click", "1")

    def double_click(self, x: int, y: int) -> Story:
        """Move there and press the left button twice."""
        words = ["mousemove", str(x), str(y), "sleep", "0.3", "click", "--repeat", "2", "--delay", "120", "1"]
        yield from self._run("xdotool", *words)

    def drag(self, start: tuple[int, int], end: tuple[int, int]) -> Story:
        """Press at `start`, let go at `end`."""
        words = ["mousemove", *map(str, start), "sleep", "0.3", "mousedown", "1", "sleep", "0.2"]
        middle = [(a + b) // 2 for a, b in zip(start, end, strict=True)]
        words += ["mousemove", *map(str, middle), "sleep", "0.1", "mousemove", *map(str, end), "sleep", "0.2"]
        yield from self._run("xdotool", *words, "mouseup", "1")

    def stroke(self, points: list[tuple[int, int]]) -> Story:
        """A brush stroke through the points; `pressed` is when the button went down."""
        yield from self._run("xdotool", "mousemove", *map(str, points[0]), "sleep", "0.3")
        self.pressed = time.monotonic()
        words = ["mousedown", "1", "sleep", "0.1"]
        for point in points[1:]:
            words += ["mousemove", *map(str, point), "sleep", "0.05"]
        yield from self._run("xdotool", *words, "sleep", "0.2", "mouseup", "1")

    def wheel(self, notches: int) -> Story:
        """Turn the mouse wheel down."""
        yield from self._run("xdotool", "click", "--repeat", str(notches), "--delay", "60", "5")

    def shoot(self, name: str) -> Story:
        """A picture of the whole screen, and where in it the 3D view is."""
        self.views[name] = self.view.open_part()
        yield from self.shoot_screen(name)

    def shoot_screen(self, name: str) -> Story:
        """A picture of the whole screen, for people alone."""
        path = str(self.out / f"{name}.png")
        yield from self._run("nice", "import", "-window", "root", "-define", "png:compression-level=9", path)

    def _run(self, *command: str) -> Story:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        # By a thread of its own: Blender may be busy with what the hands do.
        threading.Thread(target=self._note_end, args=(process,), daemon=True).start()
        yield lambda: process.poll() is not None
        if process.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}")
        yield 0.1

    def _note_end(self, process: subprocess.Popen[bytes]) -> None:
        process.wait()
        self.released = time.monotonic()


class View:
    """The 3D view of the first window. Looked up at every use: loading a file makes new ones."""

    @property
    def window(self) -> Any:
        return bpy.context.window_manager.windows[0]

    @property
    def area(self) -> Any:
        areas = (area for area in self.window.screen.areas if area.type == "VIEW_3D")
        return max(areas, key=lambda area: area.width * area.height)

    def region(self, kind: str = "WINDOW") -> Any:
        return next(region for region in self.area.regions if region.type == kind)

    @property
    def space(self) -> Any:
        return self.area.spaces.active

    def override(self, kind: str = "WINDOW") -> Any:
        """The context of an operator that a person calls in this view."""
        return bpy.context.temp_override(window=self.window, area=self.area, region=self.region(kind))

    def middle(self) -> tuple[int, int]:
        """The middle of the view in X's pixels."""
        region = self.region()
        return region.x + region.width // 2, self.window.height - (region.y + region.height // 2)

    def open_part(self) -> tuple[int, int, int, int]:
        """(left, upper, right, lower) of the view between its tools and its side bar, in X's pixels."""
        region, tools, side, height = self.region(), self.region("TOOLS"), self.region("UI"), self.window.height
        left = max(region.x, tools.x + tools.width) if tools.width > 1 else region.x
        right = min(region.x + region.width, side.x) if side.width > 1 else region.x + region.width
        header = sum(r.height for r in self.area.regions if r.type in ("HEADER", "TOOL_HEADER") and r.height > 1)
        return left, height - region.y - region.height + header, right, height - region.y

    def find_button(self, hands: Hands, operator: str) -> Generator[Wait, None, tuple[int, int] | None]:
        """Where in the side bar the button of `operator` is, found by moving the mouse down along it."""
        manager, region = bpy.context.window_manager, self.region("UI")
        x = region.x + region.width // 2
        for y in range(self.window.height - region.y - region.height + 40, self.window.height - region.y, 12):
            yield from hands.move(x, y)
            manager.clipboard = ""
            with self.override("UI"):
                if bpy.ops.ui.copy_python_command_button.poll():
                    bpy.ops.ui.copy_python_command_button()
            if operator in manager.clipboard:
                return x, y
        return None
