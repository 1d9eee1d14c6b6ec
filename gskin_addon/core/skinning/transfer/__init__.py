# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights from one shape to another that lies near it: from meshes to splats, splats to splats, splats to meshes.

After "Robust Skin Weights Transfer via Weight Inpainting" (Abdrashitov, Raichstat, Monsen, Hill 2023): what is near and
faces the same way is taken over, the rest is filled in from its neighbours. numpy only.
"""
