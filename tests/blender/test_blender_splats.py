# SPDX-License-Identifier: GPL-3.0-or-later
"""Splat objects that Blender made itself: taken over without loss, alone and by Auto-Skin."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pretend
import pytest
import splat_clouds as clouds
import worker_jobs as jobs

bpy = pytest.importorskip("bpy")

from gskin_addon.core.errors import InputError
from gskin_addon.core.splats.axes import rotate_cloud, up_rotation
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.ply import read_ply, write_ply
from gskin_addon.scene import names
from gskin_addon.scene.attributes import read_attribute, write_attribute, write_positions
from gskin_addon.scene.blender_splats import is_blender_splats, make_riggable, read_blender_cloud
from gskin_addon.scene.native_nodes import has_native_splats
from gskin_addon.scene.node_groups import find_display
from gskin_addon.scene.splat_object import is_splat_object, read_cloud
from gskin_addon.session import readiness
from gskin_addon.session.chosen import chosen_blender_splats, chosen_splats

only_native = pytest.mark.skipif(not has_native_splats(), reason="needs Blender 5.3 or later, which imports splats")


@pytest.fixture(autouse=True)
def empty():
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """GSkin registered, a worker that only pretends."""
    with pretend.session(tmp_path, monkeypatch) as scene:
        yield scene


def write_file(path: Path, cloud: SplatCloud | None = None) -> Path:
    """A PLY with harmonics of degree 2 and a further column."""
    cloud = cloud or clouds.random_cloud(60, 2)
    write_ply(path, SplatCloud(cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh,
                               extra={"label": np.arange(cloud.count, dtype=np.float32)}))  # fmt: skip
    return path


def blender_import(path: Path, **options):
    bpy.ops.wm.ply_import(filepath=str(path), **options)
    return bpy.context.view_layer.objects.active


def converted_mesh(cloud: SplatCloud):
    """What Blender's Convert to Mesh gives, with colours of a type that every version has."""
    mesh = bpy.data.meshes.new("M")
    mesh.vertices.add(cloud.count)
    write_positions(mesh, cloud.means)
    write_attribute(mesh, names.ROTATION, "QUATERNION", cloud.quats)
    write_attribute(mesh, names.SCALE, "FLOAT_VECTOR", cloud.scales)
    write_attribute(mesh, names.BASE, "FLOAT_COLOR", np.column_stack([cloud.sh[:, 0], cloud.opacities]))
    for k in range(cloud.sh.shape[1] - 1):
        write_attribute(mesh, names.SH.format(k), "FLOAT_VECTOR", cloud.sh[:, k + 1])
    obj = bpy.data.objects.new("M", mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def assert_same(found: SplatCloud, wanted: SplatCloud, tolerance: float = 2e-6) -> None:
    np.testing.assert_allclose(found.means, wanted.means, atol=tolerance)
    np.testing.assert_allclose(np.abs((found.quats * wanted.quats).sum(axis=1)), 1.0, atol=tolerance)
    np.testing.assert_allclose(found.scales, wanted.scales, rtol=1e-6)
    np.testing.assert_allclose(found.opacities, wanted.opacities, atol=1e-6)
    np.testing.assert_allclose(found.sh, wanted.sh, atol=tolerance)


@only_native
def test_blenders_ply_is_what_our_own_import_reads(tmp_path):
    path = write_file(tmp_path / "s.ply")
    obj = blender_import(path)
    assert is_blender_splats(obj)
    before = read_blender_cloud(obj)
    made = make_riggable(bpy.context, obj)
    assert made == obj
    assert is_splat_object(made)
    assert not is_blender_splats(made)
    wanted = read_ply(path).cloud
    found = read_cloud(made)
    assert_same(found, wanted)
    np.testing.assert_array_equal(found.sh, before.sh)
    np.testing.assert_array_equal(found.extra["label"], np.arange(60))
    assert names.EXTRA.format("label") in made.data.attributes
    assert "label" not in made.data.attributes
    assert find_display(made) is not None


@only_native
def test_the_object_stays_the_same_object(tmp_path):
    obj = blender_import(write_file(tmp_path / "s.ply"), up_axis="Y", forward_axis="NEGATIVE_Z", global_scale=2.0)
    parent, child = (bpy.data.objects.new(name, None) for name in ("Parent", "Child"))
    bpy.context.scene.collection.objects.link(parent)
    bpy.context.scene.collection.objects.link(child)
    parent.location = (1, 2, 3)
    obj.parent, child.parent = parent, obj
    obj["note"] = "kept"
    obj.keyframe_insert("location", frame=1)
    obj.constraints.new("LIMIT_SCALE").name = "Mine"
    other = bpy.data.objects.new("Other", None)
    bpy.context.scene.collection.objects.link(other)
    other.select_set(True)
    bpy.context.view_layer.objects.active = other
    bpy.context.view_layer.update()
    name, matrix = obj.name, obj.matrix_world.copy()
    cloud = read_blender_cloud(obj)
    make_riggable(bpy.context, obj)
    bpy.context.view_layer.update()
    assert bpy.data.objects[name] == obj
    assert obj.matrix_world == matrix
    assert (obj.parent, child.parent, obj["note"]) == (parent, obj, "kept")
    assert obj.animation_data.action is not None
    assert [c.name for c in obj.constraints] == ["Mine"]
    assert bpy.context.view_layer.objects.active == other
    assert other.select_get()
    linear = np.array(matrix)[:3, :3]
    size = np.linalg.norm(linear[:, 0])
    world = read_cloud(obj)
    np.testing.assert_allclose(world.means, cloud.means @ linear.T + np.array(matrix)[:3, 3], atol=1e-5)
    np.testing.assert_allclose(world.sh, rotate_cloud(cloud, linear / size).sh, atol=1e-5)


@only_native
def test_a_converted_mesh_is_taken_too(tmp_path):
    """Its colours are of a type that older versions do not have."""
    path = write_file(tmp_path / "s.ply")
    obj = blender_import(path)
    obj.select_set(True)
    bpy.ops.object.convert(target="MESH")
    assert obj.data.attributes[names.BASE].data_type == "FLOAT4"
    assert is_blender_splats(obj)
    make_riggable(bpy.context, obj)
    assert_same(read_cloud(obj), read_ply(path).cloud)
    assert obj.data.attributes[names.BASE].data_type == "FLOAT_COLOR"


def test_a_mesh_with_the_attributes_is_taken_in_every_version():
    cloud = clouds.random_cloud(40, 1)
    obj = converted_mesh(cloud)
    write_attribute(obj.data, "flow", "FLOAT_VECTOR", cloud.means)
    write_attribute(obj.data, "part", "INT", np.arange(40))
    assert is_blender_splats(obj)
    make_riggable(bpy.context, obj)
    found = read_cloud(obj)
    assert_same(found, cloud)
    np.testing.assert_array_equal(found.extra["part"], np.arange(40))
    np.testing.assert_array_equal(read_attribute(obj.data, "flow"), cloud.means)  # what is no column stays as it is


def test_an_unfinished_band_is_left_out():
    cloud = clouds.random_cloud(10, 2)
    obj = converted_mesh(cloud)
    obj.data.attributes.remove(obj.data.attributes[names.SH.format(5)])
    make_riggable(bpy.context, obj)
    np.testing.assert_array_equal(read_cloud(obj).sh, cloud.sh[:, :4])


@pytest.mark.parametrize("harm", ["nan", "type", "edit", "cube"])
def test_what_cannot_be_taken_is_told_and_left_alone(harm):
    cloud = clouds.random_cloud(10, 0)
    obj = converted_mesh(cloud)
    if harm == "nan":
        obj.data.attributes[names.SCALE].data[3].vector = (np.nan, 1, 1)
    elif harm == "type":
        write_attribute(obj.data, names.SCALE, "FLOAT", cloud.opacities)
    elif harm == "edit":
        bpy.context.view_layer.objects.active = obj
        bpy.ops.object.mode_set(mode="EDIT")
    else:
        obj = bpy.data.objects.new("C", bpy.data.meshes.new("C"))
    with pytest.raises(InputError, match=r"(NaN|lacks|Edit Mode|holds no)"):
        make_riggable(bpy.context, obj)
    assert not is_splat_object(obj)


def write_spz(path: Path, degree: int = 1) -> SplatCloud:
    """A file of version 3 (Niantic's format: fixed point, smallest three), and the splats in the file's own axes."""
    rng = np.random.default_rng(2)
    count, rest = 20, (degree + 1) ** 2 - 1
    fixed = rng.integers(-4000, 4000, (count, 3))
    alpha, color, scale = (rng.integers(0, 256, (count, width)).astype(np.uint8) for width in (1, 3, 3))
    sh = rng.integers(0, 256, (count, rest, 3)).astype(np.uint8)
    packed, quats = [], []
    for parts in rng.integers(-300, 300, (count, 3)).tolist():  # x, y, z; w is the largest
        word, xyz = 3, []
        for part in parts:
            word = (word << 10) | ((part < 0) << 9) | abs(part)
            xyz.append(part / 511 * 0.5**0.5)
        packed.append(struct.pack("<I", word))
        quats.append([np.sqrt(1 - np.square(xyz).sum()), *xyz])
    head = struct.pack("<IIIBBBB", 0x5053474E, 3, count, degree, 12, 0, 0)
    places = b"".join(struct.pack("<i", value)[:3] for value in fixed.ravel().tolist())
    body = (places, alpha.tobytes(), color.tobytes(), scale.tobytes(), b"".join(packed), sh.tobytes())
    path.write_bytes(gzip.compress(head + b"".join(body)))
    base = (color / 255.0 - 0.5) / 0.15
    harmonics = np.concatenate([base[:, None], (sh.astype(float) - 128) / 128], axis=1)
    return SplatCloud(fixed / 4096.0, quats, np.exp(scale / 16.0 - 10), alpha[:, 0] / 255.0, harmonics)


@only_native
def test_blenders_spz_is_turned_upright_with_its_harmonics(tmp_path):
    """The importer turns the data about x; positions, rotations and harmonics come out as one rotation."""
    wanted = rotate_cloud(write_spz(tmp_path / "s.spz"), up_rotation("y"))
    bpy.ops.wm.spz_import(filepath=str(tmp_path / "s.spz"))
    obj = bpy.context.view_layer.objects.active
    make_riggable(bpy.context, obj)
    assert_same(read_cloud(obj), wanted, 1e-5)


@only_native
def test_blenders_usd_is_taken(tmp_path):
    lines = [
        "#usda 1.0", "(", '    upAxis = "Z"', "    metersPerUnit = 1", ")",
        'def ParticleField3DGaussianSplat "S"', "{",
        "    point3f[] positions = [(1, 2, 3), (4, 5, 6)]",
        "    quatf[] orientations = [(1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5)]",
        "    float3[] scales = [(0.1, 0.2, 0.3), (0.1, 0.1, 0.2)]",
        "    float[] opacities = [0.5, 0.9]",
        "    int radiance:sphericalHarmonicsDegree = 0",
        "    float3[] radiance:sphericalHarmonicsCoefficients = [(1, 2, 3), (-1, 0, 1)]",
        "}",
    ]  # fmt: skip
    (tmp_path / "s.usda").write_text("\n".join(lines) + "\n")
    bpy.ops.wm.usd_import(filepath=str(tmp_path / "s.usda"))
    (obj,) = [o for o in bpy.data.objects if o.type == "POINTCLOUD"]
    make_riggable(bpy.context, obj)
    cloud = read_cloud(obj)
    np.testing.assert_allclose(cloud.means, [[1, 2, 3], [4, 5, 6]], atol=1e-6)
    np.testing.assert_allclose(cloud.quats[1], 0.5, atol=1e-6)
    np.testing.assert_allclose(cloud.scales, [[0.1, 0.2, 0.3], [0.1, 0.1, 0.2]], rtol=1e-6)
    np.testing.assert_allclose(cloud.sh[:, 0], [[1, 2, 3], [-1, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(cloud.opacities, [0.5, 0.9], atol=1e-6)


def test_the_check_list_says_what_happens(scene):
    obj = converted_mesh(jobs.rod(200)[0])
    pretend.add_armature()
    bpy.context.view_layer.objects.active = obj
    assert chosen_splats(bpy.context) is None
    assert chosen_blender_splats(bpy.context) == obj
    check = readiness.checks(bpy.context)[0]
    assert (check.state, check.operator) == ("warn", "gskin.make_riggable")
    assert "Blender's own splats" in check.sentence
    assert bpy.ops.gskin.make_riggable() == {"FINISHED"}
    assert chosen_splats(bpy.context) == obj
    assert readiness.checks(bpy.context)[0].state == "ok"
    assert not bpy.ops.gskin.make_riggable.poll()


def test_auto_skin_takes_them_as_they_are(scene):
    cloud = jobs.rod(200)[0]
    obj = converted_mesh(cloud)
    armature = pretend.add_armature()
    chosen = bpy.context.scene.gskin
    chosen.splats, chosen.armature = obj, armature
    assert chosen.splats == obj
    assert bpy.ops.gskin.auto_skin.poll()
    assert bpy.ops.gskin.auto_skin() == {"FINISHED"}
    assert is_splat_object(obj)
    assert obj.parent == armature
    assert len(obj.vertex_groups) > 0


def test_auto_skin_says_what_is_in_the_way_once_they_are_taken(scene):
    obj = converted_mesh(jobs.rod(200)[0])
    armature = pretend.add_armature()
    armature.scale = (1, 1, 2)
    bpy.context.view_layer.update()
    chosen = bpy.context.scene.gskin
    chosen.splats, chosen.armature = obj, armature
    with pytest.raises(RuntimeError, match="scaled unevenly"):
        bpy.ops.gskin.auto_skin()
    assert not obj.vertex_groups
