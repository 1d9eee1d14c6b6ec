# SPDX-License-Identifier: GPL-3.0-or-later
"""Splats that more than one armature's vertex groups move turn and stretch as finite differences say, live."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import rig_scenes as rigs
import splat_clouds as clouds

bpy = pytest.importorskip("bpy")

from finite_differences import apart, covariances, shown

import gskin_addon
from gskin_addon.core.rig.quaternion import quat_to_matrix
from gskin_addon.scene import handlers, leftovers, names
from gskin_addon.scene.attributes import read_attribute
from gskin_addon.scene.bone_frames import armature_of
from gskin_addon.scene.deform_stack import measured_splats, not_in_the_viewport, shown_wrongly
from gskin_addon.scene.drawn import bare, read_drawn
from gskin_addon.scene.helpers import is_helper
from gskin_addon.scene.probes import has_fitting_probes, is_probe, probes_of
from gskin_addon.scene.rotation_nodes import find_rotation
from gskin_addon.scene.splat_object import create_splat_object, read_cloud
from gskin_addon.scene.weights import write_weights

COUNT, BONES = 300, 5
DEGREES = 0.1


@pytest.fixture(scope="module", autouse=True)
def registered():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    gskin_addon.register()
    yield
    gskin_addon.unregister()


@dataclasses.dataclass
class Scene:
    """Splats of a body armature, and another armature that has moved nothing yet."""

    splats: bpy.types.Object
    body: bpy.types.Object
    prop: bpy.types.Object


@pytest.fixture
def scene():
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    for kind in (bpy.data.objects, bpy.data.meshes, bpy.data.armatures, bpy.data.lattices, bpy.data.actions):
        bpy.data.batch_remove(list(kind))
    bpy.context.view_layer.update()
    rng = np.random.default_rng(8)
    cloud = clouds.random_cloud(COUNT, 1)
    body, prop = rigs.make_chains(BONES, rng, name="Body"), rigs.make_chains(3, rng, name="Prop")
    for bone in prop.data.bones:
        bone.name = f"prop {bone.name}"
    rigs.place(prop, (0.1, 0.2, 0.3), (0.3, 0.1, -0.2), 1.3)
    splats = create_splat_object(cloud, "S")
    rigs.place(splats, (0.5, -0.2, 0.3), (0.1, 0.9, -0.5), 0.7)
    write_weights(splats, body, rigs.random_weights(cloud, BONES, rng))
    groups(splats, prop, rigs.random_weights(cloud, 3, rng), slice(0, COUNT // 2))
    pose(body, prop)
    return Scene(splats, body, prop)


def pose(*armatures, seed=3, angle=0.5):
    rng = np.random.default_rng(seed)
    for armature in armatures:
        rigs.random_pose(armature, rng, angle)
    bpy.context.view_layer.update()


def groups(obj, armature, weights, rows):
    """Vertex groups for the bones of an armature, on some splats only."""
    for bone, column in zip(armature.data.bones, weights.T, strict=True):
        group = obj.vertex_groups.get(bone.name) or obj.vertex_groups.new(name=bone.name)
        for index in range(*rows.indices(COUNT)):
            if column[index] > 0:
                group.add([index], float(column[index]), "REPLACE")


def choose(obj):
    bpy.ops.object.select_all(action="DESELECT")
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj


def named(name):
    return bpy.data.objects[name]


def add(obj, kind, place=1):
    modifier = obj.modifiers.new("More", kind)
    obj.modifiers.move(len(obj.modifiers) - 1, place)
    return modifier


def follow_prop(scene, place=1):
    modifier = add(scene.splats, "ARMATURE", place)
    modifier.object = scene.prop
    bpy.context.view_layer.update()
    return modifier


def degrees(a, b):
    """(N,) between rotations (N, 4)."""
    between = quat_to_matrix(np.asarray(a, float)).swapaxes(1, 2) @ quat_to_matrix(np.asarray(b, float))
    axial = np.stack([between[:, i, j] - between[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    return np.degrees(np.arctan2(np.linalg.norm(axial, axis=1), np.trace(between, axis1=1, axis2=2) - 1))


def assert_right(obj, *, edge=0.0):
    """Places, turns (by which harmonics are drawn) and shapes as central differences have them.

    edge: share of splats at which the modifiers are not smooth, so that differences depend on their step.
    """
    live, (points, quats, scales, turns) = shown(obj), measured_splats(obj)
    np.testing.assert_allclose(live.points, points, atol=1e-6 * np.abs(points).max())
    assert np.quantile(degrees(live.turn, turns), 1 - edge) < DEGREES
    shapes = apart(covariances(live.quats, live.scales), covariances(quats, scales))
    assert np.quantile(shapes, 1 - edge) < 5e-3
    # A test that is passed by splats at rest says nothing.
    assert np.median(degrees(turns, np.tile([1.0, 0, 0, 0], (len(turns), 1)))) > 5
    assert has_fitting_probes(obj)
    assert not_in_the_viewport(obj) == [] == shown_wrongly(obj)


# --- stacks


def another_armature(scene):
    follow_prop(scene)


def another_armature_first(scene):
    follow_prop(scene, 0)


def the_same_armature_again(scene):
    add(scene.splats, "ARMATURE").object = scene.body


def bones_of_the_same_names(scene):
    other = scene.body.copy()
    bpy.context.scene.collection.objects.link(other)
    pose(other, seed=9)
    add(scene.splats, "ARMATURE").object = other


def multi_modifier(scene):
    modifier = follow_prop(scene)
    modifier.use_multi_modifier = True


def masked(scene):
    modifier = follow_prop(scene)
    mask = scene.splats.vertex_groups.new(name="mask")
    for index in range(COUNT):
        mask.add([index], index / COUNT, "REPLACE")
    modifier.vertex_group = "mask"


def masked_the_other_way(scene):
    masked(scene)
    scene.splats.modifiers["More"].invert_vertex_group = True


def masked_multi_modifier(scene):
    masked(scene)
    scene.splats.modifiers["More"].use_multi_modifier = True


def stretched_and_mirrored(scene):
    follow_prop(scene)
    scene.prop.pose.bones[0].scale = (1, 1.8, 0.7)
    scene.body.pose.bones[0].scale = (-1, 1, 1)


def bendy(scene):
    scene.prop.data.bones[0].bbone_segments = 4
    follow_prop(scene)
    scene.prop.pose.bones[0].bbone_curveinx = 0.2


def preserved_volume(scene):
    follow_prop(scene).use_deform_preserve_volume = True


def a_lattice(scene):
    cage = bpy.data.objects.new("Cage", bpy.data.lattices.new("Cage"))
    bpy.context.scene.collection.objects.link(cage)
    cage.scale = (9, 9, 9)
    cage.data.points[0].co_deform = (-0.7, -0.9, -0.4)
    add(scene.splats, "LATTICE").object = cage


def nodes_of_the_artist(scene):
    from gskin_addon.scene.node_builder import Tree, geometry_group

    group, _ = geometry_group("Mine", 1, [])
    del group["gskin_group"]
    tree = Tree(group)
    source = tree.output(tree.node("NodeGroupInput"), "Geometry")
    place = tree.out("GeometryNodeInputPosition", "Position")
    wave = tree.scale(tree.vector("SINE", place), 0.1)
    tree.node("NodeGroupOutput", {"Geometry": tree.out("GeometryNodeSetPosition", "Geometry", {0: source, 3: wave})})
    add(scene.splats, "NODES").node_group = group


STACKS = [
    another_armature, another_armature_first, the_same_armature_again, bones_of_the_same_names, multi_modifier, masked,
    masked_the_other_way, masked_multi_modifier, stretched_and_mirrored, preserved_volume, a_lattice,
    nodes_of_the_artist,
]  # fmt: skip


@pytest.mark.parametrize("change", STACKS)
def test_splats_turn_with_all_their_modifiers(scene, change):
    change(scene)
    bpy.context.view_layer.update()
    assert_right(scene.splats)
    pose(scene.body, scene.prop, seed=5)
    assert_right(scene.splats)
    # Render Splats and exported pictures draw the same, harmonics turned.
    with bare([scene.splats]):
        bpy.context.view_layer.update()
        drawn = read_drawn(scene.splats, bpy.context.evaluated_depsgraph_get())
    assert degrees(drawn.turns, measured_splats(scene.splats)[3]).max() < DEGREES
    # One object of the artist's is in the scene as before; the others are helpers that nobody sees.
    probes = probes_of(scene.splats)
    assert len(probes) == 4
    assert sum(map(is_probe, bpy.data.objects)) == 4
    assert all(is_helper(probe) and not probe.users_collection for probe in probes)


def test_a_second_armature_with_bendy_bones(scene):
    """Between its segments a bendy bone has kinks."""
    bendy(scene)
    bpy.context.view_layer.update()
    assert_right(scene.splats, edge=0.03)


def test_envelopes(scene):
    """Where an envelope ends is an edge."""
    modifier = scene.splats.modifiers["Armature"]
    modifier.use_bone_envelopes, modifier.use_vertex_groups = True, False
    for bone in scene.body.data.bones:
        bone.envelope_distance = 2.0
    bpy.context.view_layer.update()
    assert_right(scene.splats, edge=0.1)


# --- what artists do to it


def test_another_armature_from_the_menu(scene):
    """Blender adds the modifier behind the display, where it would move nothing."""
    bpy.context.view_layer.objects.active = scene.splats
    bpy.ops.object.modifier_add(type="ARMATURE")
    scene.splats.modifiers[-1].object = scene.prop
    bpy.context.view_layer.update()
    assert [m.type for m in scene.splats.modifiers] == ["ARMATURE", "NODES", "ARMATURE", "NODES"]
    assert_right(scene.splats)


def test_tools_stay_with_the_armature_that_the_splats_are_bound_to(scene):
    first = follow_prop(scene, 0)
    assert armature_of(scene.splats) == scene.body
    cloud = read_cloud(scene.splats)
    write_weights(scene.splats, scene.body, rigs.random_weights(cloud, BONES, np.random.default_rng(2)))
    assert [m.object for m in scene.splats.modifiers if m.type == "ARMATURE"] == [scene.prop, scene.body]
    assert first.object == scene.prop
    bpy.context.view_layer.update()
    assert_right(scene.splats)


def test_weights_of_the_other_armature_painted(scene):
    follow_prop(scene)
    bpy.context.view_layer.objects.active = scene.splats
    scene.splats.vertex_groups.active = scene.splats.vertex_groups["prop bone.001"]
    before = shown(scene.splats).turn
    bpy.ops.object.vertex_group_levels(group_select_mode="ACTIVE", gain=3.0, offset=0.1)
    bpy.context.view_layer.update()
    assert degrees(shown(scene.splats).turn, before).max() > 5
    assert_right(scene.splats)
    scene.prop.data.bones["prop bone.001"].name = "wheel"
    bpy.context.view_layer.update()
    assert_right(scene.splats)


def test_settings_changed_by_hand_and_by_animation(scene):
    modifier = follow_prop(scene)
    modifier.use_multi_modifier = True
    bpy.context.view_layer.update()
    assert_right(scene.splats)
    modifier.use_multi_modifier = False
    bpy.context.view_layer.update()
    assert_right(scene.splats)
    assert sum(map(is_probe, bpy.data.objects)) == 4
    for frame, on in ((1, True), (5, False)):
        modifier.use_deform_preserve_volume = on
        modifier.keyframe_insert("use_deform_preserve_volume", frame=frame)
    bpy.context.view_layer.update()
    kept = [probe.session_uid for probe in probes_of(scene.splats)]
    for frame in range(1, 7):
        bpy.context.scene.frame_set(frame)
    # Playback makes none anew.
    assert [probe.session_uid for probe in probes_of(scene.splats)] == kept
    for frame, on in ((1, True), (6, False), (2, True)):
        bpy.context.scene.frame_set(frame)
        assert modifier.use_deform_preserve_volume is on
        assert_right(scene.splats)


def test_the_other_armature_goes(scene):
    modifier = follow_prop(scene)
    plain = find_rotation(scene.splats).node_group
    assert_right(scene.splats)
    scene.splats.modifiers.remove(modifier)
    bpy.context.view_layer.update()
    assert find_rotation(scene.splats).node_group != plain
    assert not any(map(is_probe, bpy.data.objects))
    assert not [mesh.name for mesh in bpy.data.meshes if "Probe" in mesh.name]
    rigs.assert_same_pose(scene.splats, scene.body)
    # Of no object, it moves nothing.
    follow_prop(scene)
    assert_right(scene.splats)
    bpy.data.objects.remove(scene.prop)
    bpy.context.view_layer.update()
    assert not any(map(is_probe, bpy.data.objects))
    rigs.assert_same_pose(scene.splats, scene.body)


def test_all_armatures_go(scene):
    follow_prop(scene)
    for name in ("Body", "Prop"):
        bpy.data.objects.remove(named(name))
    bpy.context.view_layer.update()
    assert find_rotation(scene.splats) is None
    assert not any(map(is_helper, [obj for obj in bpy.data.objects if "Octahedra" not in obj.name]))


def test_the_splats_go(scene):
    follow_prop(scene)
    bpy.data.objects.remove(scene.splats)
    leftovers.clean()
    assert not any(map(is_probe, bpy.data.objects))
    assert not [mesh.name for mesh in bpy.data.meshes if "Probe" in mesh.name]


@pytest.mark.parametrize("linked", [False, True])
def test_a_duplicate_has_probes_of_its_own(scene, linked):
    follow_prop(scene)
    choose(scene.splats)
    bpy.ops.object.duplicate(linked=linked)
    twin = bpy.context.object
    bpy.context.view_layer.update()
    twin.modifiers["More"].use_multi_modifier = True
    twin.location.x += 3
    bpy.context.view_layer.update()
    assert not {*probes_of(twin)} & {*probes_of(scene.splats)}
    assert_right(twin)
    assert_right(scene.splats)


def test_in_a_window_they_are_made_between_redraws(scene, monkeypatch):
    monkeypatch.setattr(handlers, "_watched", lambda: True)
    modifier = follow_prop(scene)
    assert not probes_of(scene.splats)
    while handlers._go_on() is not None:
        pass
    assert_right(scene.splats)
    modifier.show_viewport = modifier.show_render = False
    bpy.context.view_layer.update()
    while handlers._go_on() is not None:
        pass
    assert not any(map(is_probe, bpy.data.objects))
    rigs.assert_same_pose(scene.splats, scene.body)


def test_deleted_and_added_splats(scene):
    follow_prop(scene)
    choose(scene.splats)
    mesh = scene.splats.data
    mesh.vertices.foreach_set("select", np.arange(COUNT) % 3 == 0)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.delete(type="VERT")
    # Meanwhile there are more probes than splats: those turn by the vertex groups of the first armature.
    bpy.context.view_layer.update()
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    assert len(mesh.vertices) == COUNT - COUNT // 3
    assert_right(scene.splats)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    assert len(mesh.vertices) == 0


def test_undo_and_redo(scene):
    choose(scene.splats)
    bpy.ops.ed.undo_push(message="before")
    follow_prop(scene)
    bpy.ops.ed.undo_push(message="modifier")
    scene.splats.vertex_groups["prop bone.000"].remove(range(0, COUNT, 2))
    bpy.context.view_layer.update()
    assert_right(scene.splats)
    bpy.ops.ed.undo_push(message="weights")
    for step, armatures in ((bpy.ops.ed.undo, 2), (bpy.ops.ed.undo, 1), (bpy.ops.ed.redo, 2), (bpy.ops.ed.redo, 2)):
        step()
        bpy.context.view_layer.update()
        assert sum(m.type == "ARMATURE" for m in named("S").modifiers) == armatures
        if armatures == 2:
            assert_right(named("S"))
        else:
            rigs.assert_same_pose(named("S"), named("Body"))


def test_saved_loaded_and_appended(scene, tmp_path):
    follow_prop(scene)
    path = str(tmp_path / "two.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    pose(named("Body"), named("Prop"), seed=6)
    assert_right(named("S"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.append(filepath=f"{path}/Object/S", directory=f"{path}/Object/", filename="S")
    bpy.context.view_layer.update()
    pose(named("Body"), named("Prop"), seed=7)
    assert_right(named("S"))
    assert not [probe for probe in bpy.data.objects if is_probe(probe) and probe.users_collection]


def test_linked_and_overridden(scene, tmp_path):
    follow_prop(scene)
    figure = bpy.data.collections.new("Figure")
    bpy.context.scene.collection.children.link(figure)
    for obj in (scene.splats, scene.body, scene.prop):
        figure.objects.link(obj)
    path = str(tmp_path / "figure.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(path, link=True) as (_, target):
        target.collections = ["Figure"]
    linked = target.collections[0]
    bpy.context.scene.collection.children.link(linked)
    bpy.context.view_layer.update()
    splats = linked.objects["S"]
    assert not_in_the_viewport(splats) == []
    with bare([splats]):
        bpy.context.view_layer.update()
        mesh = splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        assert degrees(read_attribute(mesh, names.TURN), measured_splats(splats)[3]).max() < DEGREES
    made = linked.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    bpy.context.scene.collection.children.unlink(linked)
    bpy.context.view_layer.update()
    pose(made.all_objects["Body"], made.all_objects["Prop"], seed=4)
    assert_right(made.all_objects["S"])


# --- what does not follow is said


def test_what_moves_splats_by_their_number_is_said(scene):
    bpy.ops.mesh.primitive_uv_sphere_add(radius=6)
    target = bpy.context.object
    choose(scene.splats)
    modifier = add(scene.splats, "SURFACE_DEFORM")
    modifier.target = target
    assert bpy.ops.object.surfacedeform_bind(modifier="More") == {"FINISHED"}
    bpy.context.view_layer.update()
    (sentence,) = shown_wrongly(scene.splats)
    assert sentence == (
        "Modifier 'More' moves the splats of 'S' and turns none of them: it does not ask where they are."
    )
    # The pictures neither: what bones do is left, where all splats were gone.
    _, _, scales, _ = measured_splats(scene.splats)
    assert scales.min() > 0.5 * read_cloud(scene.splats, world=False).scales.min()
    follow_prop(scene)
    assert has_fitting_probes(scene.splats)
    assert shown_wrongly(scene.splats) == [sentence]


def test_splats_whose_probes_do_not_fit_are_said(scene):
    modifier = follow_prop(scene)
    with handlers.paused():
        modifier.use_multi_modifier = True
        assert "more than one armature moves them" in shown_wrongly(scene.splats)[0]
