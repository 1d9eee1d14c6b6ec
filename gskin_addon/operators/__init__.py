# SPDX-License-Identifier: GPL-3.0-or-later
"""One file per thing that a person can click or call."""

from __future__ import annotations
