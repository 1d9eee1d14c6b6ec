# SPDX-License-Identifier: GPL-3.0-or-later
"""The recipes that turn a job into weights, and the time that they take."""

from __future__ import annotations
