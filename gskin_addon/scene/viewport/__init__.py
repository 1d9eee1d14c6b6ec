# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats drawn as splats in the 3D view: blended Gaussians by a shader of our own, through Blender's `gpu` module."""

from __future__ import annotations
