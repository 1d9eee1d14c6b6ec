# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials of drawn splats. Their colours are captured light, so both emit and take no lamps into account."""

from __future__ import annotations

from typing import Any

import bpy

from . import names
from .node_builder import Tree

VERSION = 2

FAINTEST = 1 / 64
"""Alpha at which a rendered splat is cut off. Every hit costs Cycles a ray, so this is a matter of time."""


SEE_THROUGH = 0.75
"""Alpha of an octahedron by its splat's opacity: about the Gaussian's mean over it."""


def viewport_material() -> bpy.types.Material:
    """Flat colour from the mesh attribute `names.COLOR`, as translucent as the splat; built once per file.

    Drawn opaque, as Solid mode must, translucent splats hide what they should tint: 20 dB on a captured face, 28 so.
    """
    material, tree = _new("GSkin Splats (Viewport)")
    if tree is not None:
        color = tree.node("ShaderNodeAttribute", attribute_type="GEOMETRY", attribute_name=names.COLOR)
        shader = tree.out("ShaderNodeEmission", "Emission", {"Color": tree.output(color, "Color")})
        # Each octahedron is seen once, by its front.
        front = tree.math("SUBTRACT", 1.0, tree.out("ShaderNodeNewGeometry", "Backfacing"))
        alpha = tree.math("MULTIPLY", tree.math("MULTIPLY", tree.output(color, "Alpha"), SEE_THROUGH), front)
        clear = tree.out("ShaderNodeBsdfTransparent", "BSDF")
        shader = tree.out("ShaderNodeMixShader", "Shader", {0: alpha, 1: clear, 2: shader})
        tree.node("ShaderNodeOutputMaterial", {"Surface": shader})
        tree.lay_out()
        material.surface_render_method = "DITHERED"
    return material


def render_material() -> bpy.types.Material:
    """Gaussian fall-off over an instanced sphere that ends where alpha is `FAINTEST`; built once per file.

    Along a ray a 3D Gaussian is largest where the ray passes nearest to its centre, measured in the splat's own
    (object) space: alpha = opacity exp(-d^2 / 2) with d that distance in standard deviations. The unit sphere of the
    instance stands for d_max = sqrt(2 ln(opacity / FAINTEST)), so with r = d / d_max
    alpha = opacity (opacity / FAINTEST)^(-r^2).
    """
    material, tree = _new("GSkin Splats")
    if tree is not None:
        shader = _gaussian_shader(tree)
        tree.node("ShaderNodeOutputMaterial", {"Surface": shader})
        tree.lay_out()
        # EEVEE cannot sort splats; dithering needs no order.
        material.surface_render_method = "DITHERED"
    return material


def _gaussian_shader(tree: Tree) -> Any:
    attribute = tree.node("ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name=names.COLOR)
    geometry = tree.node("ShaderNodeNewGeometry")
    point = tree.out("ShaderNodeTexCoord", "Object")
    ray = tree.out(
        "ShaderNodeVectorTransform",
        "Vector",
        {"Vector": tree.output(geometry, "Incoming")},
        vector_type="VECTOR",
        convert_from="WORLD",
        convert_to="OBJECT",
    )
    ray = tree.vector("NORMALIZE", ray)
    nearest = tree.vector("SUBTRACT", point, tree.scale(ray, tree.vector("DOT_PRODUCT", point, ray)))
    squared = tree.vector("DOT_PRODUCT", nearest, nearest)
    opacity = tree.output(attribute, "Alpha")
    ratio = tree.math("MULTIPLY", opacity, 1 / FAINTEST)
    alpha = tree.math("MULTIPLY", opacity, tree.math("POWER", ratio, tree.math("MULTIPLY", squared, -1.0)))
    # A ray meets every sphere twice; only where it enters does the splat count.
    entering = tree.math("SUBTRACT", 1.0, tree.output(geometry, "Backfacing"))
    alpha = tree.math("MULTIPLY", alpha, entering)
    emission = tree.out("ShaderNodeEmission", "Emission", {"Color": tree.output(attribute, "Color")})
    clear = tree.out("ShaderNodeBsdfTransparent", "BSDF")
    return tree.out("ShaderNodeMixShader", "Shader", {0: alpha, 1: clear, 2: emission})


def _new(name: str) -> tuple[bpy.types.Material, Tree | None]:
    """The material of this name and our version, and its empty tree where it had to be made."""
    for material in bpy.data.materials:
        if material.get("gskin_material") == name and material.get("gskin_version") == VERSION and not material.library:
            return material, None
    material = bpy.data.materials.new(name)
    material["gskin_material"], material["gskin_version"] = name, VERSION
    material.use_nodes = True
    material.node_tree.nodes.clear()
    # Millions of tiny lamps would cost Cycles minutes, and nothing is to be lit by them.
    cycles = getattr(material, "cycles", None)
    if cycles is not None:
        cycles.emission_sampling = "NONE"
    return material, Tree(material.node_tree)
