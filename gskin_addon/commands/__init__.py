# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands behind `cli.py`, one module each with `run(options)`; they call what the operators call."""

from __future__ import annotations
