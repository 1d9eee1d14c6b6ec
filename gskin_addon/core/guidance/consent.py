# SPDX-License-Identifier: GPL-3.0-or-later
"""The user's consent to fetch models from the hub, on its way to the worker. Standard library only.

It goes with the process that is started, never through a file: a job folder, a .blend or a script that comes from
somebody else must not agree for the user.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

VARIABLE = "GSKIN_ALLOW_DOWNLOAD"
"""Environment variable of the worker; "1" if the user agreed to this run's downloads."""


def is_given() -> bool:
    """Whether the user who started this process agreed."""
    return os.environ.get(VARIABLE) == "1"


def with_consent(environment: Mapping[str, str], allow_download: bool) -> dict[str, str]:
    """`environment` for a worker, with this consent in place of any earlier one."""
    others = {name: value for name, value in environment.items() if name != VARIABLE}
    return {**others, VARIABLE: "1"} if allow_download else others
