# SPDX-License-Identifier: GPL-3.0-or-later
"""Skeletons, poses, forward kinematics and linear blend skinning; numpy only."""

from __future__ import annotations
