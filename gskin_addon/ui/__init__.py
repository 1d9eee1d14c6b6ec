# SPDX-License-Identifier: GPL-3.0-or-later
"""Panels and drawing; they name operators by their id."""

from __future__ import annotations
