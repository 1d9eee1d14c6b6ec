# SPDX-License-Identifier: GPL-3.0-or-later
"""core/worker/runtime_setup.py with fake_pip.py for pip: real environments, tiny packages, no network."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve()
sys.path[:0] = [str(HERE.parents[2])]  # started with -I, as the real one

from gskin_addon.core.worker import runtime_install  # noqa: E402
from gskin_addon.core.worker.runtime_tools import Tools  # noqa: E402

TOOLS = Tools(
    lambda env: [sys.executable, "-I", "-m", "venv", "--without-pip", str(env)],
    lambda python: [sys.executable, str(HERE.with_name("fake_pip.py")), str(python)],
    "fake",
    lambda python: [str(python), "-I", "-c", "import sys"],
    warm=False,
)

if __name__ == "__main__":
    sys.exit(runtime_install.main(tools=lambda choice: TOOLS))
