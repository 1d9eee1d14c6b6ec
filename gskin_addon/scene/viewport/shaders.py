# SPDX-License-Identifier: GPL-3.0-or-later
"""The shaders: Gaussian splats as quads (EWA splatting, Zwicker et al. 2001; Kerbl et al. 2023), and their composite.

The vertex shader is `core.render.screen_space` in GLSL. Made through `GPUShaderCreateInfo`, so that OpenGL, Metal and
Vulkan have them. Push constants are 128 bytes at most; everything larger is a texture.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import gpu

from ...core.render.screen_space import DILATION, EDGE

gpu_types: Any = gpu.types
gpu_state: Any = gpu.state
"""Blender's own; published typings lack most of it."""

WIDTH = 2048
"""Splats of one row of the textures."""

_SPLAT_VERTEX = """
ivec2 place_of(int i) { return ivec2(i % ROW_WIDTH, i / ROW_WIDTH); }

mat3 rotation(vec4 q) {
  q = normalize(q);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  ivec2 at = place_of(int(texelFetch(orders, place_of(gl_InstanceID), 0).r + 0.5));
  vec4 point = texelFetch(points, at, 0);
  vec4 color = texelFetch(colors, at, 0);
  int object = int(point.w + 0.5);
  vec4 row0 = texelFetch(objects, ivec2(3 * object, 0), 0);
  vec4 row1 = texelFetch(objects, ivec2(3 * object + 1, 0), 0);
  vec4 row2 = texelFetch(objects, ivec2(3 * object + 2, 0), 0);
  vec4 here = vec4(point.xyz, 1.0);
  vec3 p = vec3(dot(row0, here), dot(row1, here), dot(row2, here));
  /* Anything that is not drawn becomes a quad without area. */
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  corner = vec2(0.0);
  premultiplied = vec4(0.0);
  float opacity = color.a;
  bool parallel = lens.w > 0.5;
  float depth = parallel ? 1.0 : -p.z;
  if (opacity * 255.0 < 1.0 || depth <= 1e-6) {
    return;
  }
  vec2 ndc = (focal * p.xy + shift * p.z + offset) / depth;
  vec2 half_size = 0.5 * size;
  vec3 across, upward;
  if (parallel) {
    across = vec3(focal.x, 0.0, shift.x);
    upward = vec3(0.0, focal.y, shift.y);
  }
  else {
    vec2 inside = clamp(ndc, -SPLAT_EDGE, SPLAT_EDGE) + shift;
    across = vec3(focal.x, 0.0, inside.x) / depth;
    upward = vec3(0.0, focal.y, inside.y) / depth;
  }
  across *= half_size.x;
  upward *= half_size.y;
  mat3 axes = transpose(mat3(row0.xyz, row1.xyz, row2.xyz)) * rotation(texelFetch(rotations, at, 0));
  vec3 scale = texelFetch(scales, at, 0).xyz;
  vec3 u = (across * axes) * scale;
  vec3 v = (upward * axes) * scale;
  float xx = dot(u, u) + SPLAT_DILATION, yy = dot(v, v) + SPLAT_DILATION, xy = dot(u, v);
  /* The ellipse's axes: eigenvectors of the 2x2 covariance. */
  float mean = 0.5 * (xx + yy);
  float apart = length(vec2(0.5 * (xx - yy), xy));
  vec2 variance = vec2(mean + apart, max(mean - apart, SPLAT_DILATION));
  vec2 axis = abs(xy) > 1e-9 ? normalize(vec2(xy, variance.x - xx)) : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float reach = sqrt(2.0 * log(255.0 * opacity));
  corner = reach * side;
  vec2 stretched = sqrt(variance) * corner;
  vec2 moved = axis * stretched.x + vec2(-axis.y, axis.x) * stretched.y;
  float z = (lens.x * p.z + lens.y) / depth;
  gl_Position = vec4(ndc + moved / half_size, z, 1.0);
  premultiplied = vec4(color.rgb, opacity);
}
"""

_SPLAT_FRAGMENT = """
void main() {
  float alpha = min(premultiplied.a * exp(-0.5 * dot(corner, corner)), 0.99);
  if (alpha * 255.0 < 1.0) {
    discard;
  }
#ifdef BEHIND_OTHERS
  if (gl_FragCoord.z > texelFetch(depths, ivec2(gl_FragCoord.xy), 0).r) {
    discard;
  }
#endif
  fragColor = vec4(premultiplied.rgb * alpha, alpha);
}
"""

# A stroke of round ends from one place to another; a dot where they are the same.
_MARK_VERTEX = """
ivec2 place_of(int i) { return ivec2(i % ROW_WIDTH, i / ROW_WIDTH); }

void main() {
  int first = 3 * gl_InstanceID;
  vec4 a = texelFetch(strokes, place_of(first), 0);
  vec4 b = texelFetch(strokes, place_of(first + 1), 0);
  ends = vec4((0.5 * a.xy + 0.5) * size, (0.5 * b.xy + 0.5) * size);
  vec2 along = ends.zw - ends.xy;
  vec2 forward = length(along) > 1e-3 ? normalize(along) : vec2(1.0, 0.0);
  float reach = a.w + 1.0;
  at = (side.x < 0.0 ? ends.xy : ends.zw) + reach * (side.x * forward + side.y * vec2(-forward.y, forward.x));
  tint = vec4(texelFetch(strokes, place_of(first + 2), 0).rgb, a.w);
  rim = b.w;
  gl_Position = vec4(2.0 * at / size - 1.0, side.x < 0.0 ? a.z : b.z, 1.0);
}
"""

_MARK_FRAGMENT = """
void main() {
  vec2 along = ends.zw - ends.xy;
  float share = clamp(dot(at - ends.xy, along) / max(dot(along, along), 1e-6), 0.0, 1.0);
  float away = distance(at, ends.xy + share * along);
  float cover = clamp(tint.a + 0.5 - away, 0.0, 1.0);
  if (cover <= 0.0) {
    discard;
  }
  float inside = rim > 0.5 ? clamp(tint.a - 0.5 - away, 0.0, 1.0) : 1.0;
  fragColor = vec4(tint.rgb * inside * cover, cover);
}
"""

_OCCLUDER_VERTEX = """
void main() {
  gl_Position = to_clip * vec4(point, 1.0);
}
"""

_OCCLUDER_FRAGMENT = """
void main() {
  fragColor = vec4(0.0);
}
"""

_SCREEN_VERTEX = """
void main() {
  gl_Position = vec4(side, 0.0, 1.0);
}
"""

# The view's framebuffer blends linear colours and stores sRGB: what was blended in sRGB is decoded once.
_COMPOSITE_FRAGMENT = """
float to_linear(float c) {
  return c <= 0.04045 ? c / 12.92 : pow((c + 0.055) / 1.055, 2.4);
}

float cover(ivec2 at) {
  return texelFetch(outlined, clamp(at, ivec2(0), textureSize(outlined, 0) - 1), 0).a;
}

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy) - ivec2(corner_of_view);
  float kept = keep_overlay > 0.5 ? texelFetch(overlay, at, 0).r : 0.0;
  vec4 c = texelFetch(drawn, at, 0);
  if (mark_opacity > 0.0) {
    vec4 m = texelFetch(marks, at, 0) * mark_opacity;
    c = m + c * (1.0 - m.a);
  }
  vec3 color = vec3(0.0);
  if (c.a > 0.0) {
    vec3 srgb = clamp(c.rgb / c.a, 0.0, 1.0);
    color = vec3(to_linear(srgb.r), to_linear(srgb.g), to_linear(srgb.b)) * c.a;
  }
  float alpha = min(c.a, 1.0);
  if (outline_color.a > 0.0 && cover(at) < 0.5) {
    float near = 0.0;
    for (int x = -1; x <= 1; x++) {
      for (int y = -1; y <= 1; y++) {
        near = max(near, cover(at + ivec2(x, y) * reach));
      }
    }
    if (near >= 0.5) {
      color = outline_color.rgb;
      alpha = 1.0;
    }
  }
  fragColor = vec4(color, alpha) * (1.0 - kept);
}
"""


@cache
def splat_shader(*, behind_others: bool) -> Any:
    """Draws one quad per splat; with `behind_others` it leaves out what lies behind the texture `depths`."""
    info = gpu_types.GPUShaderCreateInfo()
    between = gpu_types.GPUStageInterfaceInfo("gskin_splat")
    between.smooth("VEC2", "corner")
    between.flat("VEC4", "premultiplied")
    names = ["orders", "points", "rotations", "scales", "colors", "objects"]
    if behind_others:
        info.define("BEHIND_OTHERS", "1")
        names.append("depths")
    for slot, name in enumerate(names):
        info.sampler(slot, "FLOAT_2D", name)
    info.define("ROW_WIDTH", str(WIDTH))
    info.define("SPLAT_DILATION", str(DILATION))
    info.define("SPLAT_EDGE", str(EDGE))
    info.push_constant("VEC4", "lens")
    info.push_constant("VEC2", "focal")
    info.push_constant("VEC2", "shift")
    info.push_constant("VEC2", "offset")
    info.push_constant("VEC2", "size")
    info.vertex_in(0, "VEC2", "side")
    info.vertex_out(between)
    return _compiled(info, _SPLAT_VERTEX, _SPLAT_FRAGMENT)


@cache
def composite_shader() -> Any:
    """Lays a drawn target over the view, decoded to linear colours, with an outline where `outlined` ends."""
    info = gpu_types.GPUShaderCreateInfo()
    for slot, name in enumerate(("drawn", "outlined", "overlay", "marks")):
        info.sampler(slot, "FLOAT_2D", name)
    info.push_constant("FLOAT", "mark_opacity")
    info.push_constant("VEC4", "outline_color")
    info.push_constant("VEC2", "corner_of_view")
    info.push_constant("FLOAT", "keep_overlay")
    info.push_constant("INT", "reach")
    info.vertex_in(0, "VEC2", "side")
    return _compiled(info, _SCREEN_VERTEX, _COMPOSITE_FRAGMENT)


@cache
def mark_shader() -> Any:
    """Draws one stroke per instance, see `marks.py`."""
    info = gpu_types.GPUShaderCreateInfo()
    between = gpu_types.GPUStageInterfaceInfo("gskin_mark")
    between.smooth("VEC2", "at")
    between.flat("VEC4", "ends")
    between.flat("VEC4", "tint")
    between.flat("FLOAT", "rim")
    info.define("ROW_WIDTH", str(WIDTH))
    info.sampler(0, "FLOAT_2D", "strokes")
    info.push_constant("VEC2", "size")
    info.vertex_in(0, "VEC2", "side")
    info.vertex_out(between)
    return _compiled(info, _MARK_VERTEX, _MARK_FRAGMENT)


@cache
def occluder_shader() -> Any:
    """Draws triangles in nothing, for their depths."""
    info = gpu_types.GPUShaderCreateInfo()
    info.push_constant("MAT4", "to_clip")
    info.vertex_in(0, "VEC3", "point")
    return _compiled(info, _OCCLUDER_VERTEX, _OCCLUDER_FRAGMENT)


def _compiled(info: Any, vertex: str, fragment: str) -> Any:
    """The shader of two sources; its colour goes to `fragColor`."""
    info.fragment_out(0, "VEC4", "fragColor")
    info.vertex_source(vertex)
    info.fragment_source(fragment)
    return gpu.shader.create_from_info(info)


@cache
def square() -> Any:
    """A square of half width one, for `draw_instanced`; the composite's covers the whole screen."""
    form = gpu_types.GPUVertFormat()
    form.attr_add(id="side", comp_type="F32", len=2, fetch_mode="FLOAT")
    corners = gpu_types.GPUVertBuf(form, 4)
    corners.attr_fill("side", [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)])
    return gpu_types.GPUBatch(type="TRI_STRIP", buf=corners)


def forget() -> None:
    """Give shaders and the square back, as when the add-on is turned off."""
    for made in (splat_shader, composite_shader, mark_shader, occluder_shader, square):
        made.cache_clear()
