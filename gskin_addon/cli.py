# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line: `gskin ...`, `blender -b -c gskin ...` and `blender -b --python cli.py -- ...`.

Exit codes: 0 done, 2 bad input, 1 failure, 130 cancelled. Errors are one sentence on stderr.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import importlib
import importlib.util
import os
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

CANCELLED = 130


def program() -> NoReturn:
    """Entry of the program `gskin`: one command, then the end of the process."""
    sys.exit(_whole_process(main))


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; `argv` without the program's name (default: this process's). Returns the exit code."""
    from .commands import parser as parsers

    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        options = parsers.build().parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    return execute(options)


def execute(options: argparse.Namespace) -> int:
    """Run parsed options and turn whatever goes wrong into one sentence and an exit code."""
    from .commands.console import print_message, quiet_stdout
    from .core.errors import Cancelled, GSkinError, Stopped
    from .core.files import disk_error

    previous = _interruptible()
    try:
        module = importlib.import_module(f".commands.{options.command.replace('-', '_')}", __package__)
        with contextlib.nullcontext() if options.verbose else quiet_stdout():
            module.run(options)
    except Stopped as stop:
        print_message(_sentence(stop))
        return CANCELLED
    except (KeyboardInterrupt, Cancelled):
        print_message("Cancelled; no output was written.")
        return CANCELLED
    except GSkinError as error:
        print_message(_sentence(error), getattr(error, "traceback", "") if options.verbose else "")
        return error.exit_code
    except OSError as error:
        print_message(_sentence(disk_error(error)), traceback.format_exc() if options.verbose else "")
        return 1
    except Exception as error:
        hint = "" if options.verbose else "; run again with --verbose for the details"
        details = traceback.format_exc() if options.verbose else ""
        print_message(f"gskin failed unexpectedly ({type(error).__name__}: {error}){hint}.", details)
        return 1
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    return 0


def blender_command(argv: Sequence[str]) -> int:
    """Entry of `blender -b -c gskin ...`, for `bpy.utils.register_cli_command`."""
    return main(list(argv))


def _interruptible() -> dict[int, Any]:
    """Let Ctrl-C and SIGTERM raise KeyboardInterrupt, against Blender's handlers; gives the old ones."""
    previous: dict[int, Any] = {}
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        try:
            if number is not None and (old := signal.getsignal(number)) is not signal.SIG_IGN:
                signal.signal(number, _interrupt)
                previous[number] = old if old is not None else signal.SIG_DFL
        except ValueError:
            break  # not the main thread: whoever owns it decides
    return previous


def _interrupt(number: int, frame: Any) -> NoReturn:
    raise KeyboardInterrupt


def _sentence(error: BaseException) -> str:
    # Runs of spaces stay: they may be part of a file's name. A name at the beginning stands in quotes.
    text = " ".join(line.strip() for line in str(error).strip().splitlines()) or type(error).__name__
    return text[:1].upper() + text[1:]


def _whole_process(run: Callable[[], int]) -> int:
    """Run what is all that this process does, and see that it ends.

    bpy 4.5 as a module waits for ever in its destructors after a glTF export: they destroy what a thread of its own
    still waits for. There the process ends before them, and takes along the folder that Blender would have removed.
    """
    code = 1

    def leave() -> None:
        bpy = sys.modules.get("bpy")
        if bpy is not None and not bpy.app.binary_path and bpy.app.version < (5, 0, 0):
            session = Path(bpy.app.tempdir)
            if session.name.startswith("blender_"):
                shutil.rmtree(session, ignore_errors=True)
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(OSError, ValueError):
                    stream.flush()
            os._exit(code)

    # Functions that are registered first run last: after bpy's.
    atexit.register(leave)
    code = run()
    return code


def _started_as_file() -> int:
    """Entry when this file itself was started: load the package around it, by its path."""
    root = Path(__file__).resolve().parent
    name = root.name
    # Python put this file's folder first on the path; its module names are not meant for everybody.
    sys.path[:] = [entry for entry in sys.path if not entry or Path(entry).resolve() != root]
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(
            name, root / "__init__.py", submodule_search_locations=[str(root)]
        )
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    package = importlib.import_module(f"{name}.cli")
    # In Blender, its own options come first and ours follow a double dash.
    ours = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    if "--" not in sys.argv and "bpy" in sys.modules and sys.modules["bpy"].app.binary_path:
        ours = []
    return int(package.main(ours))


if __name__ == "__main__":
    sys.exit(_whole_process(_started_as_file))
