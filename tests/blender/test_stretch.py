# SPDX-License-Identifier: GPL-3.0-or-later
"""Bones that do more than turn: viewport and posed splats against finite differences of the modifiers."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
import pytest
from bent_rig import SPLATS, bend, bent_rig, bind, segments
from finite_differences import apart, covariances, shown, truth

from gskin_addon.scene import handlers
from gskin_addon.scene.deform_stack import beyond_linear_blending, lost_in_gltf, not_in_the_viewport, shown_wrongly
from gskin_addon.scene.drawn import bare, read_drawn
from gskin_addon.scene.posing import posed_cloud
from gskin_addon.scene.splat_object import read_cloud, replace_cloud
from gskin_addon.scene.weights import update_rotation_weights


@pytest.fixture
def rig():
    """Splats around a chain of four crooked bones, the middle two of which may get segments."""
    return bent_rig()


def same_as_posed(obj, live, tolerance: float = 1e-3) -> None:
    """The viewport and what `gskin pose` writes are one."""
    cloud = posed_cloud(obj)
    np.testing.assert_allclose(live.points, cloud.means, atol=1e-5)
    assert apart(covariances(live.quats, live.scales), covariances(cloud.quats, cloud.scales)).max() < tolerance


def scale_evenly(armature) -> None:
    armature.pose.bones["b2"].scale = (2, 2, 2)


def scale_unevenly(armature) -> None:
    armature.pose.bones["b2"].scale = (0.7, 1.8, 1.2)


def mirror(armature) -> None:
    armature.pose.bones["b0"].scale = (-1, 1, 1)


def mirror_and_scale(armature) -> None:
    armature.pose.bones["b0"].scale = (1.5, -0.8, 1)


def stretch_to(armature) -> None:
    target = bpy.data.objects.new("Target", None)
    target.location = (1.9, 0.1, 0.5)
    bpy.context.scene.collection.objects.link(target)
    constraint = armature.pose.bones["b2"].constraints.new("STRETCH_TO")
    constraint.target = target


def do_not_inherit_scale(armature) -> None:
    scale_unevenly(armature)
    armature.data.bones["b3"].inherit_scale = "NONE"


def inherit_average(armature) -> None:
    scale_unevenly(armature)
    armature.data.bones["b3"].inherit_scale = "AVERAGE"


UNEVEN = [scale_unevenly, mirror_and_scale, stretch_to, do_not_inherit_scale, inherit_average]


@pytest.mark.parametrize("change", [*UNEVEN, scale_evenly, mirror])
@pytest.mark.parametrize("bent", [False, True])
def test_splats_are_stretched_by_their_bones(rig, change, bent):
    obj, armature = rig
    weights = bind(obj, armature)
    if bent:
        bend(armature)
    change(armature)
    live, real, rest = shown(obj), truth(obj), read_cloud(obj)
    np.testing.assert_allclose(live.points, real.points, atol=1e-5)
    same_as_posed(obj, live)
    held = apart(covariances(live.quats, live.scales), real.covariances(rest.quats, rest.scales))
    # Where bones that turn differently are blended, the modifier itself shrinks what is around; splats do not.
    alone = weights.max(axis=1) > 0.999
    assert alone.sum() > 40
    assert held[alone].max() < 0.02
    assert real.turn_error(live.turn)[alone].max() < 1
    if change in UNEVEN or change is scale_evenly:
        affected = weights[:, 2:].sum(axis=1) > 0.01 if change is not mirror_and_scale else weights.max(axis=1) > 0
        if change is scale_evenly:
            affected &= weights[:, :2].sum(axis=1) > 0.01  # b3 is scaled with b2: between the two it is Eq. 3
        assert real.turn_error(live.turn)[affected].max() < 1


def test_a_scaled_root_scales_all(rig):
    obj, armature = rig
    bind(obj, armature)
    rest = read_cloud(obj)
    armature.pose.bones["b0"].scale = (2, 2, 2)
    live = shown(obj)
    np.testing.assert_allclose(live.scales, 2 * rest.scales, rtol=1e-5)
    np.testing.assert_allclose(posed_cloud(obj).scales, 2 * rest.scales, rtol=1e-5)


@pytest.mark.parametrize("count", [2, 5, 16])
def test_bendy_bones(rig, count):
    obj, armature = rig
    segments(armature, count)
    bind(obj, armature)
    bend(armature)
    live, real = shown(obj), truth(obj)
    np.testing.assert_allclose(live.points, real.points, atol=1e-5)
    same_as_posed(obj, live, 0.02)
    assert real.turn_error(live.turn).max() < 1
    assert np.percentile(real.turn_error(live.turn), 50) < 0.1


def test_bendy_bones_with_curves_scales_and_a_moved_armature(rig):
    obj, armature = rig
    segments(armature, 6)
    bind(obj, armature)
    bend(armature)
    bone = armature.pose.bones["b1"]
    bone.bbone_curveinx, bone.bbone_curveoutz, bone.bbone_rollout = 0.1, -0.15, 0.6
    bone.bbone_easein, bone.bbone_scaleout = 1.6, (1.4, 1.3, 0.7)
    live, real = shown(obj), truth(obj)
    same_as_posed(obj, live, 0.12)
    # So sharp a bend folds the space at one splat, which has no turn then.
    folded = np.linalg.det(real.maps) < 0
    assert folded.sum() <= 2
    assert real.turn_error(live.turn)[~folded].max() < 1
    before = live
    armature.location, armature.rotation_euler, armature.scale = (1, 2, 3), (0.3, 0.4, 0.5), (1.5, 1.5, 1.5)
    live = shown(obj)
    np.testing.assert_allclose(live.scales, before.scales, rtol=2e-3)
    assert truth(obj).turn_error(live.turn)[~folded].max() < 1
    cloud = posed_cloud(obj)
    matrix = np.array(obj.matrix_world)[:3]
    np.testing.assert_allclose(live.points @ matrix[:, :3].T + matrix[:, 3], cloud.means, atol=2e-5)


def test_a_bendy_bone_at_rest_changes_nothing(rig):
    obj, armature = rig
    segments(armature, 8)
    bind(obj, armature)
    rest, live = read_cloud(obj), shown(obj)
    np.testing.assert_allclose(live.scales, rest.scales)
    np.testing.assert_allclose(np.abs((live.quats * rest.quats).sum(axis=1)), 1, atol=1e-6)


def test_plain_rotations_keep_every_bit_beside_a_stretched_bone(rig):
    """Splats of bones that only turn are as without the other bone's stretch."""
    obj, armature = rig
    bind(obj, armature, sharpness=200.0)
    bend(armature)
    before, posed = shown(obj), posed_cloud(obj)
    armature.pose.bones["b3"].scale = (1, 2, 1)
    live, after = shown(obj), posed_cloud(obj)
    group = obj.vertex_groups["b3"].index
    free = np.array([all(g.group != group or g.weight == 0 for g in v.groups) for v in obj.data.vertices])
    assert free.sum() > 100 > 0 < (~free).sum()
    for name in ("quats", "scales", "turn"):
        np.testing.assert_array_equal(getattr(live, name)[free], getattr(before, name)[free])
    for name in ("means", "quats", "scales", "sh"):
        np.testing.assert_array_equal(getattr(after, name)[free], getattr(posed, name)[free])


def test_segments_given_later_are_taken_over(rig):
    obj, armature = rig
    bind(obj, armature)
    segments(armature, 6)
    update_rotation_weights(obj)
    bend(armature)
    assert truth(obj).turn_error(shown(obj).turn).max() < 1


def test_segments_are_noticed_where_the_add_on_looks_at_edits(rig):
    obj, armature = rig
    bind(obj, armature)
    bpy.app.handlers.depsgraph_update_post.append(handlers.follow_edits)
    try:
        segments(armature, 6)
        bpy.context.view_layer.update()
    finally:
        bpy.app.handlers.depsgraph_update_post.remove(handlers.follow_edits)
    bend(armature)
    assert truth(obj).turn_error(shown(obj).turn).max() < 1


def test_splats_replaced_under_bendy_bones_keep_their_place_along_them(rig):
    obj, armature = rig
    segments(armature, 6)
    bind(obj, armature)
    cloud = read_cloud(obj, world=False)
    replace_cloud(obj, dataclasses.replace(cloud, means=cloud.means + np.float32([0.06, 0, 0])))
    bend(armature)
    assert truth(obj).turn_error(shown(obj).turn).max() < 1


def preserve_volume(obj, armature, modifier) -> None:
    modifier.use_deform_preserve_volume = True


def envelopes(obj, armature, modifier) -> None:
    modifier.use_bone_envelopes, modifier.use_vertex_groups = True, False


def multiplied(obj, armature, modifier) -> None:
    armature.data.bones["b2"].use_envelope_multiply = True


def masked(obj, armature, modifier) -> None:
    group = obj.vertex_groups.new(name="mask")
    for index in range(len(obj.data.vertices)):
        group.add([index], 0.4, "REPLACE")
    modifier.vertex_group = "mask"


def masked_the_other_way(obj, armature, modifier) -> None:
    masked(obj, armature, modifier)
    modifier.invert_vertex_group = True


def two_armatures(obj, armature, modifier) -> None:
    other = armature.copy()
    bpy.context.scene.collection.objects.link(other)
    other.pose.bones["b1"].scale = (1, 1.5, 1)
    second = obj.modifiers.new("Second", "ARMATURE")
    second.object, second.use_multi_modifier = other, True
    obj.modifiers.move(len(obj.modifiers) - 1, 1)


def lattice(obj, armature, modifier) -> None:
    cage = bpy.data.objects.new("Cage", bpy.data.lattices.new("Cage"))
    bpy.context.scene.collection.objects.link(cage)
    cage.location, cage.scale = (1, 0, 0), (3, 1, 1)
    cage.data.points[0].co_deform = (-0.7, -0.9, -0.4)
    bpy.context.view_layer.update()
    second = obj.modifiers.new("Lattice", "LATTICE")
    second.object = cage
    obj.modifiers.move(len(obj.modifiers) - 1, 1)


@pytest.mark.parametrize(
    "change",
    [preserve_volume, envelopes, multiplied, masked, masked_the_other_way, two_armatures, lattice],
)
def test_posed_splats_follow_what_else_the_modifiers_do(rig, change):
    obj, armature = rig
    bind(obj, armature)
    bend(armature)
    armature.pose.bones["b3"].scale = (1.3, 1.3, 1.3)
    change(obj, armature, obj.modifiers["Armature"])
    assert beyond_linear_blending(obj)
    cloud, real, rest = posed_cloud(obj), truth(obj), read_cloud(obj)
    np.testing.assert_allclose(cloud.means, real.points, atol=1e-5)
    error = apart(covariances(cloud.quats, cloud.scales), real.covariances(rest.quats, rest.scales))
    # Envelopes end with an edge, across which differences depend on their step.
    assert np.percentile(error, 95) < 0.02
    # Render Splats and --view camera draw the same.
    with bare([obj]):
        bpy.context.view_layer.update()
        drawn = read_drawn(obj, bpy.context.evaluated_depsgraph_get())
    if change is not preserve_volume:
        np.testing.assert_allclose(drawn.points, cloud.means, atol=1e-5)
        error = apart(covariances(drawn.rotations, drawn.scales), covariances(cloud.quats, cloud.scales))
        assert np.percentile(error, 95) < 1e-3
        assert shown_wrongly(obj)[0].startswith("Blender turns the splats of 'Splats' by vertex groups alone")
    assert [o.name for o in bpy.data.objects if o.name.startswith("Splats")] == ["Splats"]


def test_what_gltf_has_no_word_for_is_said(rig):
    obj, armature = rig
    bind(obj, armature)
    assert lost_in_gltf(obj) == []
    segments(armature, 4)
    preserve_volume(obj, armature, obj.modifiers["Armature"])
    bendy, volume = lost_in_gltf(obj)
    assert bendy == (
        "glTF has no bendy bones: 2 that move 'Splats' ('b1', 'b2') are without segments in it, and what bends along "
        "them is straight."
    )
    assert "'Armature' preserves volume" in volume
    assert not_in_the_viewport(obj) == []
    envelopes(obj, armature, obj.modifiers["Armature"])
    assert not_in_the_viewport(obj)[0] == "'Armature' uses bone envelopes"


def test_mirrored_harmonics(rig):
    """A colour that a splat shows towards a direction at rest, it shows towards the mirrored direction."""
    from gskin_addon.core.splats.sh import eval_sh

    obj, armature = rig
    bind(obj, armature)
    armature.pose.bones["b0"].scale = (-1, 1, 1)
    bpy.context.view_layer.update()
    rest, posed = read_cloud(obj), posed_cloud(obj)
    axis = np.array(armature.data.bones["b0"].matrix_local)[:3, 0]
    ways = np.random.default_rng(0).normal(size=(SPLATS, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    reflected = ways - 2 * (ways @ axis)[:, None] * axis
    np.testing.assert_allclose(
        eval_sh(posed.sh, reflected.astype(np.float32)), eval_sh(rest.sh, ways.astype(np.float32)), atol=1e-4
    )
