# SPDX-License-Identifier: GPL-3.0-or-later
"""The programs that make an environment and install into it, uv or pip, and what their failures mean."""

from __future__ import annotations

import importlib.util
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..errors import GSkinError, InputError
from .runtime_choice import PIP, Choice

# Wheels only: building from source would run code of the package, and need a compiler.
_PIP_OPTIONS = (
    "--no-input",
    "--disable-pip-version-check",
    "--no-warn-script-location",
    "--progress-bar=off",
    "--only-binary=:all:",
)


@dataclass(frozen=True)
class Tools:
    """The commands that make an environment and install into it; tests bring their own."""

    make: Callable[[Path], list[str]]
    install: Callable[[Path], list[str]]
    name: str
    alive: Callable[[Path], list[str]]
    warm: bool = True


def find_tools(choice: Choice) -> Tools:
    """uv where it is on the PATH (it knows nothing of pip's settings, so not for the source "pip"), else venv and pip.

    Raises:
        InputError: this Python can make no environments, and there is no uv.
    """
    own = importlib.util.find_spec("venv") is not None and importlib.util.find_spec("ensurepip") is not None
    uv = _find_uv()
    if uv is not None and (choice.source.kind != PIP or not own):
        return Tools(
            lambda env: [uv, "venv", "--quiet", "--allow-existing", "--python", sys.executable, str(env)],
            lambda python: [uv, "pip", "install", "--python", str(python), "--only-binary=:all:"],
            "uv",
            lambda python: [str(python), "-I", "-c", "import sys"],
        )
    if not own:
        raise InputError(
            f"The Python '{sys.executable}' can make no environment (venv or ensurepip is missing); "
            "install python3-venv (Debian, Ubuntu: sudo apt install python3-venv) or uv, then try again."
        )
    return Tools(
        lambda env: [sys.executable, "-I", "-m", "venv", str(env)],
        lambda python: [str(python), "-I", "-X", "utf8", "-m", "pip", "install", *_PIP_OPTIONS],
        "pip",
        lambda python: [str(python), "-I", "-m", "pip", "--version"],
    )


def explain_failure(output: str, choice: Choice, last: str) -> GSkinError:
    """One sentence with reason and remedy for what pip or uv wrote before it failed."""
    source = choice.source
    found = re.search(r"(?:satisfies the requirement|distribution found for|No solution found.*?)\s+(\S+)", output)
    if re.search(r"No space left|not enough space|Errno 28|os error 28|disk quota", output, re.I):
        return GSkinError("The disk is full; free some space and install again, it goes on from here.")
    if re.search(r"hash(es)? (do not|mismatch)|DO NOT MATCH THE HASHES", output, re.I):
        return GSkinError(f"A download is damaged ({last}); install again.")
    if re.search(r"BadZipFile|is not a zip file|has an invalid wheel|is invalid|[Ii]nvalid zip|corrupt", output):
        wheel = re.search(r"[\w./\\:-]+\.whl", output)
        name = f"'{Path(wheel.group()).name}'" if wheel else "A package"
        return GSkinError(f"{name} is damaged ({last}); fetch it again (or `pip cache purge`) and install again.")
    if re.search(
        r"NewConnectionError|NameResolution|name resolution|getaddrinfo|Max retries|ProxyError|"
        r"Connection ?(refused|reset|aborted|broken)|ReadTimeout|timed out|Network is unreachable|"
        r"dns error|error sending request",
        output,
    ):
        return GSkinError(
            f"The package index cannot be reached ({source.sentence}); check the connection, or choose a wheel folder."
        )
    if re.search(r"CERTIFICATE_VERIFY_FAILED|SSLError|certificate", output):
        return GSkinError("The package index's certificate is not trusted here; ask your administrator for PIP_CERT.")
    if re.search(r"Permission denied|Access is denied|WinError 5|Read-only file system", output):
        return GSkinError(f"A file cannot be written ({last}); end Blender's jobs, check the permissions, try again.")
    if found or re.search(r"not a supported wheel|no matching distribution|No solution found", output, re.I):
        name = found.group(1) if found else "a package"
        version = ".".join(str(number) for number in sys.version_info[:2])
        where = f"The wheel folder '{source.place}'"
        if source.needs_network:
            where = f"The package index ({source.sentence})"
        return GSkinError(
            f"{where} has no {name} for Python {version} on this system; choose another source or backend."
        )
    return GSkinError(f"The packages could not be installed: {last}; the log in the folder says more.")


def _find_uv() -> str | None:
    found = shutil.which("uv")
    # Windows looks into the current folder first, which may be anybody's.
    return None if found is None or Path(found).absolute().parent == Path.cwd() else found
