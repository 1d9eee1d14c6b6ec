# SPDX-License-Identifier: GPL-3.0-or-later
"""The process that draws frames: they come through stdin, pictures go to files, and lines of JSON say how far it is.

{"stage": "compiling"} where the kernels are not in the user's cache yet, which takes some seconds, once;
{"stage": "drawing", "number", "fraction"}, {"stage": "drawn", "number", "seconds"} for each frame;
{"stage": "error", "error", "traceback"} ends it. It ends, too, when stdin closes.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

from ..render.frame import draw_frame
from ..render.output import write_picture
from . import job_runner, parent_watch
from .frame_pipe import read_frames


def main() -> int:
    """Draw until stdin closes; returns the exit code."""
    send = job_runner.take_stdout()
    if os.name == "posix":
        parent_watch.die_with_parent(signal.SIGKILL)
    try:
        _compile(send)
        for number, frame, output in read_frames(sys.stdin.buffer):
            begun = time.monotonic()

            def show(share: float, number: int = number) -> None:
                send({"stage": "drawing", "number": number, "fraction": round(share, 3)})

            show(0.0)
            picture, hidden = draw_frame(frame, show)
            write_picture(picture, hidden, output)
            send({"stage": "drawn", "number": number, "seconds": round(time.monotonic() - begun, 3)})
        return 0
    except Exception as error:  # told to the one who waits, whatever it is
        code, sentence, details = job_runner.explain(error)
        send({"stage": "error", "error": sentence, "traceback": details, "exit_code": code})
        return code


def _compile(send: Callable[[dict[str, Any]], None]) -> None:
    """Have the kernels ready before the first frame comes, and say so where that takes a while."""
    if importlib.util.find_spec("numba") is None:
        return
    from ..render.cpu import still

    if still.has_to_compile():
        send({"stage": "compiling"})
    still.compile_kernel()
