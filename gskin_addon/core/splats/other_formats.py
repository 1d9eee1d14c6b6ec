# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that people try to open as splats and that are not read: what they are, and what to do."""

from __future__ import annotations

TRANSFORM = "turn it into a .ply or .sog with splat-transform (npm install -g @playcanvas/splat-transform)"
_TRAINED = "export a .ply from the program that trained it"
_MESH = "a mesh, not Gaussian splats; import it with File > Import, and choose a file of splats here"
_POINTS = "a point cloud, not Gaussian splats; train splats on its photographs, and export them as .ply"
_USD = "USD, which is not read here; import it in Blender 5.3 or later with File > Import > USD, and use that object"

REMEDIES: dict[str, str] = {
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _USD),
    **dict.fromkeys((".lcc", ".lcc2"), f"a capture of XGRIDS; {TRANSFORM}"),
    **dict.fromkeys((".las", ".laz", ".e57", ".pts", ".pcd", ".xyz"), _POINTS),
    **dict.fromkeys((".obj", ".fbx", ".stl", ".dae", ".abc", ".3mf", ".off"), _MESH),
    **dict.fromkeys((".ckpt", ".pt", ".pth"), f"a training state; {_TRAINED} (nerfstudio: ns-export gaussian-splat)"),
    ".html": "a web page with splats; export them from SuperSplat as .ply or .sog",
    ".blend": "a Blender file; open it with File > Open, or append its objects",
    ".gz": "packed; unpack it and choose what is in it",
    ".json": f"no meta.json of a .sog; choose that or the .sog, and of a streamed one (lod-meta.json), {TRANSFORM}",
}
"""By suffix; each stands after "<file> is"."""
