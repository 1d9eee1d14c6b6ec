# SPDX-License-Identifier: GPL-3.0-or-later
"""Splat clouds, their files and axes; numpy only, so that it imports inside Blender."""

from __future__ import annotations
