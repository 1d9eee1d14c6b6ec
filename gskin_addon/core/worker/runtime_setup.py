# SPDX-License-Identifier: GPL-3.0-or-later
"""The program that makes, completes and repairs the learning runtime: a process of its own, never Blender's.

python -I -u runtime_setup.py install|repair --folder F --backend cpu --source pytorch [--place X] [--no-diffusion]

It prints JSON lines: {"stage", "fraction" (0 to 1 of the whole), "message"}, {"stage": "log", "line"}, and at last
{"stage": "done", "message"} or {"stage": "error", "error" (one sentence), "exit_code"}. Closing a piped stdin, SIGTERM
or SIGINT cancels it at once; the same command goes on from what is there. Packages are wheels with fixed requirements,
installed by uv where it is on the PATH, else by pip in the new environment; nothing is built, no shell is used.

Started by its path, it loads the package around it as process.py does.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import sys
from pathlib import Path


def main() -> int:
    """Run what the command line says; returns the exit code."""
    if importlib.util.find_spec("numpy") is None:  # Blender's own Python has it
        sentence = f"The Python '{sys.executable}' lacks numpy, which gskin needs; name another one."
        print(json.dumps({"stage": "error", "error": sentence, "exit_code": 2}), flush=True)
        return 2
    spec = importlib.util.spec_from_file_location("gskin_process", Path(__file__).with_name("process.py"))
    assert spec is not None
    assert spec.loader is not None
    process = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(process)
    return int(importlib.import_module(f"{process.load_package()}.core.worker.runtime_install").main())


if __name__ == "__main__":
    sys.exit(main())
