# SPDX-License-Identifier: GPL-3.0-or-later
"""Nodes for poses in which bones are stretched, mirrored or bent: splats turn and stretch by their local map.

The formulas are those of `core.rig.stretch` and `core.rig.bendy`, in 32 bits and with the strongest bones. Splats all
of whose bones are plain rotations get Eq. 3 as ever.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import bpy

from ..core.rig.stretch import PLAINLY, RIGID
from . import names
from .frame_nodes import choose, direction, matrix_of
from .node_algebra import Columns, combine, jacobi, parts, vector
from .node_builder import Input, Tree, function_group

VERSION = 2
"""Of the node groups."""

SWEEPS = 4
NEWTON_STEPS = 3
FLATTEST = 1e-5
"""Thickness relative to the longest axis at which a flat splat still has a direction in 32 bits."""
COLLAPSED = 1e-3
"""Determinant of tr(S) - S, relative to an unstretched one, below which a map has no rotation of its own."""

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


_COLUMNS = ("Column 1", "Column 2", "Column 3")
_MAP = dict.fromkeys(_COLUMNS, "Vector")


@dataclasses.dataclass
class Influence:
    """What one of a splat's bones does to it, as fields: weight; turn (rotation); FRAME_STRETCH; columns of its map."""

    weight: Any
    turn: Any
    stretch: Any
    columns: Columns


def stretch_parts(*, bendy: bool) -> tuple[Callable[[], object], ...]:
    """What builds the groups of `influences` and `stretched_splats`, each after those that it uses itself."""
    return _polar_step_group, _local_map_group, _shape_group, lambda: _influence_group(bendy=bendy)


def _polar_step_group() -> bpy.types.NodeTree:
    kinds = {**_MAP, "Rotation": "Rotation"}
    return function_group("GSkin Polar Step", VERSION, kinds, {"Rotation": "Rotation", "Sound": "Float"}, _polar_step)


def _local_map_group() -> bpy.types.NodeTree:
    kinds = {**_MAP, "Turn": "Rotation", "Spins": "Matrix"}
    return function_group("GSkin Local Map", VERSION, kinds, _MAP, _local_map)


def _shape_group() -> bpy.types.NodeTree:
    kinds = {**_MAP, "Uneven": "Float", "Spins": "Matrix"}
    return function_group("GSkin Stretched Shape", VERSION, kinds, {"Shape": "Matrix"}, _shape)


def _influence_group(*, bendy: bool) -> bpy.types.NodeTree:
    outputs = {"Turn": "Rotation", "Stretch": "Vector", **_MAP}
    name, build = ("GSkin Bendy Influence", _bendy) if bendy else ("GSkin Influence", _plain)
    return function_group(name, VERSION, {"Bones": "Geometry", "Bone": "Int"}, outputs, build)


def influences(tree: Tree, bones: Any, *, bendy: bool) -> list[Influence]:
    """The splat's influences from the points of `frame_nodes.bone_points`; `bendy` where some bones have segments."""
    group = _influence_group(bendy=bendy)
    found = []
    for slot in range(names.INFLUENCES):
        made = tree.call(group, {"Bones": bones, "Bone": tree.attribute(names.BONE.format(slot), "INT")})
        weight = tree.attribute(names.WEIGHT.format(slot), "FLOAT")
        found.append(Influence(weight, made["Turn"], made["Stretch"], [made[label] for label in _COLUMNS]))
    return found


def stretched_splats(tree: Tree, splats: Any, found: list[Influence]) -> Any:
    """The geometry with ROTATION, SCALE and TURN as the local maps have them.

    splats: with ROTATION at rest, and TURN blended by Eq. 3 already.
    """
    stretch: Any = (0.0, 0.0, 0.0)
    smallest: Any = None
    spins = []
    for each in found:
        held = tree.math("GREATER_THAN", each.weight, 0.0)
        stretch = tree.vector("MAXIMUM", stretch, tree.scale(each.stretch, held))
        # The strongest bone comes first; where another has no weight, its size stands for that one's.
        size = parts(tree, each.stretch)[2]
        own = size if smallest is None else choose(tree, held, smallest, size, "FLOAT")
        smallest = own if smallest is None else tree.math("MINIMUM", smallest, own)
        w, v = _quaternion(tree, each.turn)
        root = tree.math("SQRT", tree.math("MULTIPLY", each.weight, size))
        spins += [tree.math("MULTIPLY", w, root), *parts(tree, tree.scale(v, root))]
    weights = [each.weight for each in found]
    inputs = {
        label: combine(tree, [each.columns[k] for each in found], weights) for k, label in enumerate(_COLUMNS)
    }
    own, even, largest = parts(tree, stretch)
    spread = tree.math("SUBTRACT", tree.math("DIVIDE", largest, smallest), 1.0)
    inputs["Uneven"] = tree.math("MAXIMUM", even, spread)
    inputs["Spins"] = tree.out("FunctionNodeCombineMatrix", "Matrix", dict(enumerate(spins)))
    return _with_shape(tree, splats, tree.math("GREATER_THAN", own, RIGID), inputs)


def shaped_splats(tree: Tree, splats: Any, columns: Columns, selected: Any) -> Any:
    """The geometry with ROTATION, SCALE and TURN as local maps, by their columns, have them where `selected`.

    splats: with ROTATION at rest, and TURN near the maps' own rotations; where not selected it turns them as it is.
    """
    inputs = dict(zip(_COLUMNS, columns, strict=True))
    # Turned by the map alone, and nothing that blending rotations has lost is given back.
    inputs["Uneven"] = 1.0
    inputs["Spins"] = tree.out("FunctionNodeCombineMatrix", "Matrix", dict.fromkeys(range(16), 0.0))
    return _with_shape(tree, splats, selected, inputs)


def _with_shape(tree: Tree, splats: Any, selected: Any, inputs: dict[str, Any]) -> Any:
    # One attribute, so that all of it is computed once, and for the selected splats only.
    shape = tree.call(_shape_group(), inputs)["Shape"]
    inputs = {"Geometry": splats, "Selection": selected, "Name": names.SHAPE, "Value": shape}
    splats = tree.out(
        "GeometryNodeStoreNamedAttribute", "Geometry", inputs, data_type="FLOAT4X4", domain="POINT"
    )
    return tree.call(
        function_group("GSkin Take Shape", VERSION, {"Geometry": "Geometry"}, {"Geometry": "Geometry"}, _take_shape),
        {"Geometry": splats},
    )["Geometry"]


def _take_shape(tree: Tree, given: Input) -> dict[str, Any]:
    """SHAPE as ROTATION, SCALE and TURN; splats that have none are turned as Eq. 3 says."""
    splats = given("Geometry")
    node = tree.node("FunctionNodeSeparateMatrix", {"Matrix": tree.attribute(names.SHAPE, "FLOAT4X4")})
    numbers = [node.outputs[k] for k in range(16)]
    columns = [vector(tree, numbers[4 * k : 4 * k + 3]) for k in range(3)]
    w, x, y, z = (numbers[4 * k + 3] for k in range(4))
    turn = tree.out("FunctionNodeQuaternionToRotation", "Rotation", {"W": w, "X": x, "Y": y, "Z": z})
    axes = {"Primary Axis": columns[0], "Secondary Axis": columns[1]}
    shaped = tree.out("FunctionNodeAxesToRotation", "Rotation", axes, primary_axis="X", secondary_axis="Y")
    at_rest, blended = (tree.attribute(name, "QUATERNION") for name in (names.ROTATION, names.TURN))
    inputs = {"Rotation": at_rest, "Rotate By": blended}
    turned = tree.out("FunctionNodeRotateRotation", "Rotation", inputs, rotation_space="GLOBAL")
    # The shape is zero where nothing was selected.
    changed = tree.math("GREATER_THAN", tree.vector("DOT_PRODUCT", columns[0], columns[0]), 0.0)
    splats = tree.store(splats, names.ROTATION, "QUATERNION", choose(tree, changed, turned, shaped, "ROTATION"))
    lengths = vector(tree, [tree.vector("LENGTH", column) for column in columns])
    for name, kind, value in ((names.SCALE, "FLOAT_VECTOR", lengths), (names.TURN, "QUATERNION", turn)):
        inputs = {"Geometry": splats, "Selection": changed, "Name": name, "Value": value}
        splats = tree.out("GeometryNodeStoreNamedAttribute", "Geometry", inputs, data_type=kind, domain="POINT")
    return {"Geometry": tree.out("GeometryNodeRemoveAttribute", "Geometry", {"Geometry": splats, "Name": names.SHAPE})}


def _sampled(tree: Tree, bones: Any, name: str, kind: str, index: Any) -> Any:
    inputs = {"Geometry": bones, "Value": tree.attribute(name, kind), "Index": index}
    return tree.out("GeometryNodeSampleIndex", "Value", inputs, data_type=kind, domain="POINT")


def _plain(tree: Tree, given: Input) -> dict[str, Any]:
    """An influence where no bone has segments."""
    bones, bone = given("Bones"), given("Bone")
    columns = _columns(tree, _sampled(tree, bones, names.FRAME_LOCAL, "FLOAT4X4", bone))[:3]
    # No bone (-1): the splat stays as it is.
    some = tree.math("GREATER_THAN", bone, -0.5)
    columns = [choose(tree, some, axis, column) for axis, column in zip(AXES, columns, strict=True)]
    turn = _sampled(tree, bones, names.TURN, "QUATERNION", bone)
    # No bone has size 1.
    stretch = _sampled(tree, bones, names.FRAME_STRETCH, "FLOAT_VECTOR", bone)
    stretch = choose(tree, some, AXES[2], stretch)
    return {"Turn": turn, "Stretch": stretch, **dict(zip(_COLUMNS, columns, strict=True))}


def _bendy(tree: Tree, given: Input) -> dict[str, Any]:
    """An influence of a bone that may have segments: by the splat's place along it, two joints or one frame."""
    bones, bone = given("Bones"), given("Bone")
    first, segments, span = parts(tree, _sampled(tree, bones, names.FRAME_BEND, "FLOAT_VECTOR", bone))
    start = tree.math("MAXIMUM", first, bone)
    into = _sampled(tree, bones, names.FRAME_INVERSE, "FLOAT4X4", start)
    inputs = {"Vector": tree.attribute(names.REST, "FLOAT_VECTOR"), "Transform": into}
    place = parts(tree, tree.out("FunctionNodeTransformPoint", "Vector", inputs))
    along = tree.math("DIVIDE", place[1], span)
    in_front, behind = tree.math("LESS_THAN", 0.0, along), tree.math("LESS_THAN", along, segments)
    some = tree.math("GREATER_THAN", segments, 0.5)
    inside = tree.math("MULTIPLY", some, tree.math("MULTIPLY", in_front, behind))
    number = tree.math("MINIMUM", tree.math("FLOOR", along), tree.math("SUBTRACT", segments, 1.0))
    share = tree.math("MULTIPLY", tree.math("SUBTRACT", along, number), inside)
    # Beyond the tail: the frame after the last joint.
    past = tree.math("MULTIPLY", tree.math("MULTIPLY", some, in_front), tree.math("SUBTRACT", 1.0, behind))
    low: Any = choose(tree, inside, bone, tree.math("ADD", first, number), "FLOAT")
    low = choose(tree, past, low, tree.math("ADD", tree.math("ADD", first, segments), 1.0), "FLOAT")
    high = tree.math("ADD", low, inside)

    maps = [_columns(tree, _sampled(tree, bones, names.FRAME_MAP, "FLOAT4X4", index)) for index in (low, high)]
    (x0, y0, z0, c0), (x1, _, z1, c1) = maps
    x_change, z_change = tree.vector("SUBTRACT", x1, x0), tree.vector("SUBTRACT", z1, z0)
    # Between two joints the place is bilinear across and quadratic along; the middle of the segment says how.
    middle = tree.vector("SUBTRACT", y0, tree.scale(tree.vector("ADD", c0, c1), 0.5))
    bulge = tree.math("MULTIPLY_ADD", share, -8.0, 4.0)
    y = tree.vector("ADD", tree.vector("SUBTRACT", c1, c0), tree.scale(middle, bulge))
    y = tree.vector("ADD", y, tree.vector("ADD", tree.scale(x_change, place[0]), tree.scale(z_change, place[2])))
    y = choose(tree, inside, y0, tree.scale(y, tree.math("DIVIDE", 1.0, span)))
    x = tree.vector("ADD", x0, tree.scale(x_change, share))
    z = tree.vector("ADD", z0, tree.scale(z_change, share))
    inverse = _sampled(tree, bones, names.FRAME_INVERSE, "FLOAT4X4", low)
    held = tree.math("GREATER_THAN", bone, -0.5)
    columns = []
    for axis in AXES:
        column = combine(tree, [x, y, z], parts(tree, direction(tree, axis, inverse)))
        columns.append(choose(tree, held, axis, column))

    turns = [_sampled(tree, bones, names.TURN, "QUATERNION", index) for index in (low, high)]
    between = _between(tree, turns[0], turns[1], share)
    alone = turns[0]
    turn = choose(tree, inside, alone, between, "ROTATION")
    stretch = choose(tree, held, AXES[2], _sampled(tree, bones, names.FRAME_STRETCH, "FLOAT_VECTOR", low))
    return {"Turn": turn, "Stretch": stretch, **dict(zip(_COLUMNS, columns, strict=True))}


def _shape(tree: Tree, given: Input) -> dict[str, Any]:
    """Matrix of the new axes, columns as long as the splat's scales, and below them the turn (w x y z).

    Inputs: columns of the blended map J; unevenness; spins, a matrix with the columns sqrt(w_b s_b) q_b (w x y z).
    """
    columns, uneven = [given(label) for label in _COLUMNS], given("Uneven")
    blended = tree.attribute(names.TURN, "QUATERNION")
    # Mirrored with its bones, the splat is minus a rotation; folded by a bend it has none of its own.
    near = [tree.vector("DOT_PRODUCT", _turned(tree, axis, blended), c) for axis, c in zip(AXES, columns, strict=True)]
    trace = tree.math("ADD", tree.math("ADD", near[0], near[1]), near[2])
    sign = tree.math("MULTIPLY_ADD", tree.math("LESS_THAN", trace, 0.0), -2.0, 1.0)
    columns = [tree.scale(column, sign) for column in columns]
    volume = tree.vector("DOT_PRODUCT", columns[0], tree.vector("CROSS_PRODUCT", columns[1], columns[2]))
    own, sound = _newton(tree, columns, blended)
    sound = tree.math("MULTIPLY", sound, tree.math("GREATER_THAN", volume, 0.0))
    share = tree.math("DIVIDE", tree.math("SUBTRACT", uneven, RIGID), PLAINLY - RIGID)
    share = tree.math("MINIMUM", tree.math("MAXIMUM", share, 0.0), 1.0)
    smooth = tree.math("MULTIPLY_ADD", share, -2.0, 3.0)
    share = tree.math("MULTIPLY", tree.math("MULTIPLY", share, share), tree.math("MULTIPLY", smooth, sound))
    turn = _between(tree, blended, own, share)
    inputs = {**dict(zip(_COLUMNS, columns, strict=True)), "Turn": turn, "Spins": given("Spins")}
    maps = [*tree.call(_local_map_group(), inputs).values()]
    sizes = parts(tree, tree.attribute(names.SCALE, "FLOAT_VECTOR"))
    longest = tree.math("MAXIMUM", tree.math("MAXIMUM", sizes[0], sizes[1]), sizes[2])
    old = tree.attribute(names.ROTATION, "QUATERNION")
    shape = []
    for axis, size in zip(AXES, sizes, strict=True):
        relative = tree.math("MAXIMUM", tree.math("DIVIDE", size, longest), FLATTEST)
        moved = combine(tree, maps, parts(tree, _turned(tree, axis, old)))
        shape.append(tree.scale(moved, relative))
    for _ in range(SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            shape[p], shape[q] = jacobi(tree, shape[p], shape[q])
    shape = [tree.scale(column, longest) for column in shape]
    w, v = _quaternion(tree, turn)
    return {"Shape": matrix_of(tree, [*shape, (0.0, 0.0, 0.0)], [w, *parts(tree, v)])}


def _local_map(tree: Tree, given: Input) -> dict[str, Any]:
    """Columns of M = R ((R^T J)_sym + K), R the turn."""
    axes = [_turned(tree, axis, given("Turn")) for axis in AXES]
    product = [[tree.vector("DOT_PRODUCT", axis, given(label)) for axis in axes] for label in _COLUMNS]
    stretch = zip(_symmetric(tree, product), _lost(tree, given("Spins"), given("Turn")), strict=True)
    maps = [combine(tree, axes, parts(tree, tree.vector("ADD", *pair))) for pair in stretch]
    return dict(zip(_COLUMNS, maps, strict=True))


def _between(tree: Tree, a: Any, b: Any, share: Any) -> Any:
    """The rotation of (1 - share) a + share b, as unit quaternions of the same sign."""

    def build(tree: Tree, given: Input) -> dict[str, Any]:
        (w0, v0), (w1, v1) = (_quaternion(tree, given(label)) for label in "AB")
        share = given("Share")
        agree = tree.math("MULTIPLY_ADD", w0, w1, tree.vector("DOT_PRODUCT", v0, v1))
        sign = tree.math("MULTIPLY_ADD", tree.math("LESS_THAN", agree, 0.0), -2.0, 1.0)
        other, rest = tree.math("MULTIPLY", share, sign), tree.math("SUBTRACT", 1.0, share)
        w = tree.math("MULTIPLY_ADD", w0, rest, tree.math("MULTIPLY", w1, other))
        v = tree.vector("ADD", tree.scale(v0, rest), tree.scale(v1, other))
        length = tree.math("SQRT", tree.math("MULTIPLY_ADD", w, w, tree.vector("DOT_PRODUCT", v, v)))
        values = [tree.math("DIVIDE", value, length) for value in (w, *parts(tree, v))]
        inputs = dict(zip("WXYZ", values, strict=True))
        return {"Rotation": tree.out("FunctionNodeQuaternionToRotation", "Rotation", inputs)}

    kinds = {"A": "Rotation", "B": "Rotation", "Share": "Float"}
    group = function_group("GSkin Rotation Between", VERSION, kinds, {"Rotation": "Rotation"}, build)
    return tree.call(group, {"A": a, "B": b, "Share": share})["Rotation"]


def _newton(tree: Tree, columns: Columns, start: Any) -> tuple[Any, Any]:
    """The rotation of the map's polar decomposition, from a rotation near it, and whether it has one (1, else 0)."""
    group = _polar_step_group()
    inputs = dict(zip(_COLUMNS, columns, strict=True))
    made = [tree.call(group, {**inputs, "Rotation": start})]
    for _ in range(NEWTON_STEPS - 1):
        made.append(tree.call(group, {**inputs, "Rotation": made[-1]["Rotation"]}))
    return made[-1]["Rotation"], made[0]["Sound"]


def _polar_step(tree: Tree, given: Input) -> dict[str, Any]:
    """With B = R^T J, (tr(B_sym) - B_sym) x = axial(B) turns R by x towards the rotation of J."""
    columns, rotation = [given(label) for label in _COLUMNS], given("Rotation")
    axes = [_turned(tree, axis, rotation) for axis in AXES]
    product = [[tree.vector("DOT_PRODUCT", axis, column) for axis in axes] for column in columns]
    trace = tree.math("ADD", tree.math("ADD", product[0][0], product[1][1]), product[2][2])
    # product[c][r] is the entry of row r and column c.
    pairs = ((1, 2), (2, 0), (0, 1))
    axial = vector(tree, [tree.math("SUBTRACT", product[i][j], product[j][i]) for i, j in pairs])
    rows = [
        tree.vector("SUBTRACT", tree.scale(axis, trace), column)
        for axis, column in zip(AXES, _symmetric(tree, product), strict=True)
    ]
    crossed = [tree.vector("CROSS_PRODUCT", rows[i], rows[j]) for i, j in pairs]
    determinant = tree.vector("DOT_PRODUCT", rows[0], crossed[0])
    solved = vector(tree, [tree.vector("DOT_PRODUCT", axial, cross) for cross in crossed])
    solved = tree.scale(solved, tree.math("DIVIDE", 1.0, determinant))
    limit = tree.math("MULTIPLY", tree.math("POWER", tree.math("ABSOLUTE", trace), 3.0), COLLAPSED * 8 / 27)
    inputs = {"Axis": solved, "Angle": tree.vector("LENGTH", solved)}
    little = tree.out("FunctionNodeAxisAngleToRotation", "Rotation", inputs)
    inputs = {"Rotation": rotation, "Rotate By": little}
    turned = tree.out("FunctionNodeRotateRotation", "Rotation", inputs, rotation_space="LOCAL")
    return {"Rotation": turned, "Sound": tree.math("GREATER_THAN", determinant, limit)}


def _symmetric(tree: Tree, product: list[list[Any]]) -> Columns:
    """The columns of B_sym, for B by the entries of its columns."""
    found = []
    for i in range(3):
        entries = [
            product[i][i] if i == j else tree.math("MULTIPLY", tree.math("ADD", product[i][j], product[j][i]), 0.5)
            for j in range(3)
        ]
        found.append(vector(tree, entries))
    return found


def _lost(tree: Tree, spins: Any, turn: Any) -> Columns:
    """K of `core.rig.stretch`: 2 (tr V - V), V = sum_b w_b s_b v_b v_b^T, v_b the vector part of conj(turn) q_b."""
    w, v = _quaternion(tree, turn)
    x, y, z = parts(tree, v)
    minus = [tree.math("MULTIPLY", value, -1.0) for value in (x, y, z)]
    # By columns: what conj(turn) does to w, x, y and z; the last row would be the real part.
    numbers = [*minus, 0.0, w, minus[2], y, 0.0, z, w, minus[0], 0.0, minus[1], x, w, 0.0]
    left = tree.out("FunctionNodeCombineMatrix", "Matrix", dict(enumerate(numbers)))
    product = tree.out("FunctionNodeMatrixMultiply", "Matrix", {0: left, 1: spins})
    transposed = tree.out("FunctionNodeTransposeMatrix", "Matrix", {"Matrix": product})
    totals = _columns(tree, tree.out("FunctionNodeMatrixMultiply", "Matrix", {0: product, 1: transposed}))[:3]
    diagonal = [parts(tree, total)[k] for k, total in enumerate(totals)]
    trace = tree.math("ADD", tree.math("ADD", diagonal[0], diagonal[1]), diagonal[2])
    return [
        tree.scale(tree.vector("SUBTRACT", tree.scale(axis, trace), total), 2.0)
        for axis, total in zip(AXES, totals, strict=True)
    ]


def _columns(tree: Tree, matrix: Any) -> Columns:
    """The four columns of a matrix field, as vectors."""
    node = tree.node("FunctionNodeSeparateMatrix", {"Matrix": matrix})
    return [vector(tree, [node.outputs[4 * k + row] for row in range(3)]) for k in range(4)]


def _turned(tree: Tree, axis: Any, rotation: Any) -> Any:
    return tree.out("FunctionNodeRotateVector", "Vector", {"Vector": axis, "Rotation": rotation})


def _quaternion(tree: Tree, rotation: Any) -> tuple[Any, Any]:
    node = tree.node("FunctionNodeRotationToQuaternion", {"Rotation": rotation})
    return tree.output(node, "W"), vector(tree, [tree.output(node, axis) for axis in "XYZ"])
