# SPDX-License-Identifier: GPL-3.0-or-later
"""A pip that fetches nothing: `fake_pip.py PYTHON [options] requirements` puts tiny packages beside PYTHON.

$GSKIN_FAKE_PIP: "hang:NAME" sits in the middle of NAME with a child, as pip may; "fail:TEXT" prints TEXT and exits 1;
"broken:NAME" installs a NAME that does not import. $GSKIN_FAKE_CALLS names a file that gets a line per package made.
"""

from __future__ import annotations

import base64
import hashlib
import os
import subprocess
import sys
import time
from pathlib import Path

MODULES = {"pillow": "PIL", "warp-lang": "warp"}
TORCH = "class cuda:\n    is_available = staticmethod(lambda: False)\n"


def main() -> int:
    python, arguments = Path(sys.argv[1]), sys.argv[2:]
    kind, _, what = os.environ.get("GSKIN_FAKE_PIP", "").partition(":")
    if kind == "fail":
        print(what, flush=True)
        return 1
    packages = next(python.parent.parent.glob("lib/python3*/site-packages"))
    names = [a.replace("=", ">").split(">")[0] for a in arguments if not a.startswith("-")]
    for name in [*names, *(["numpy"] if "scipy" in names else [])]:
        install(packages, name, kind, what)
    return 0


def install(packages: Path, name: str, kind: str, what: str) -> None:
    info = packages / f"{name.replace('-', '_')}-2.13.0.dist-info"
    if (info / "METADATA").is_file():  # which is all that pip looks at, too
        print(f"Requirement already satisfied: {name}", flush=True)
        return
    print(f"Collecting {name}\nInstalling collected packages: {name}", flush=True)
    module = packages / MODULES.get(name, name)
    module.mkdir(exist_ok=True)
    code = "raise ImportError('half a wheel')" if (kind, what) == ("broken", name) else "__version__ = '2.13.0'\n"
    (module / "__init__.py").write_text(code + (TORCH if name == "torch" else ""))
    (module / "data.bin").write_bytes(b"0123456789" * 50)
    info.mkdir(exist_ok=True)
    (info / "METADATA").write_text(f"Name: {name}\n")
    if (kind, what) == ("hang", name):  # after METADATA and before RECORD, the worst moment
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        Path(os.environ["GSKIN_FAKE_CALLS"] + ".pids").write_text(f"{os.getpid()} {child.pid}")
        print("hanging", flush=True)
        time.sleep(600)
    rows = [row(packages, path) for path in (module / "__init__.py", module / "data.bin", info / "METADATA")]
    (info / "RECORD").write_text("\n".join([*rows, f"{info.name}/RECORD,,"]) + "\n")
    with open(os.environ["GSKIN_FAKE_CALLS"], "a") as file:
        file.write(name + "\n")


def row(packages: Path, path: Path) -> str:
    data = path.read_bytes()
    digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
    return f"{path.relative_to(packages).as_posix()},sha256={digest},{len(data)}"


if __name__ == "__main__":
    sys.exit(main())
