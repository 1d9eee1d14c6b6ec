# SPDX-License-Identifier: GPL-3.0-or-later
"""Our readers and writers against other people's: gaussforge and gsply (PyPI), splat-transform (npm)."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from npm import npm_folder
from splat_clouds import ASSETS, random_cloud

from gskin_addon.core.rig.quaternion import quat_to_matrix
from gskin_addon.core.splats.axes import rotate_cloud
from gskin_addon.core.splats.cloud import SplatCloud
from gskin_addon.core.splats.formats import FORMATS, read_splats
from gskin_addon.core.splats.loaded import with_degree
from gskin_addon.core.splats.morton import morton_order
from gskin_addon.core.splats.ply import write_ply
from gskin_addon.core.splats.spz import write_spz

TRANSFORM = "@playcanvas/splat-transform@2.7.1"
"""The last release that runs on Node 20."""
HALF_TURN = np.diag([1.0, -1.0, -1.0])
"""From the axes of training programs (right, down, front) to those of .spz (right, up, back), and back."""


@pytest.fixture(scope="module")
def cloud() -> SplatCloud:
    """600 splats along a curve, as writers that sort them leave them."""
    made = random_cloud(600, 3)
    return replace(made, sh=0.2 * made.sh).select(morton_order(made.means))


@pytest.fixture(scope="module")
def forge():
    """(bytes, from, to, options) -> bytes by gaussforge."""
    program = pytest.importorskip("gaussforge").GaussForge()

    def convert(data: bytes, source: str, target: str, **options: int) -> bytes:
        result = program.convert(data, source, target, **options)
        assert "error" not in result, result
        return bytes(result["data"])

    return convert


@pytest.fixture(scope="module")
def transform():
    """(from, to, *options): a file into another by splat-transform, with its own axes of training programs."""
    folder = npm_folder("splat-transform", TRANSFORM)
    program = folder / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"

    def convert(source: Path, target: Path, *options: str) -> Path:
        command = ["node", str(program), "-q", "-w", *options, str(source), str(target)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        if "ERR_REQUIRE" in done.stderr or "SyntaxError" in done.stderr:
            pytest.skip("this node is too old for splat-transform")
        assert done.returncode == 0, done.stdout + done.stderr
        return target

    return convert


def covariances(cloud: SplatCloud) -> np.ndarray:
    """(N, 3, 3), each of norm 1: unlike quaternions, the same however a splat's own axes are named."""
    matrix = quat_to_matrix(cloud.quats.astype(np.float64)) * cloud.scales[:, None].astype(np.float64)
    square = matrix @ matrix.transpose(0, 2, 1)
    return square / np.linalg.norm(square, axis=(1, 2))[:, None, None]


def assert_same(found: SplatCloud, wanted: SplatCloud, *, covariance=2e-6, opacity=2e-6) -> None:
    """The same values, up to float32 and what becomes of an opacity that is kept as a logit."""
    assert found.count == wanted.count
    assert found.sh_degree == wanted.sh_degree
    np.testing.assert_allclose(found.means, wanted.means, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(np.log(found.scales), np.log(wanted.scales), rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.opacities, wanted.opacities, rtol=0, atol=opacity)
    np.testing.assert_allclose(found.sh, wanted.sh, rtol=0, atol=1e-5)
    np.testing.assert_allclose(covariances(found), covariances(wanted), rtol=0, atol=covariance)


# .splat: their quaternions are b / 127.5 - 1, ours (b - 128) / 128, as the viewer of the format has it.
QUANTISED = {"splat": 0.02}


@pytest.mark.parametrize("name", ["splat", "ksplat", "spz", "sog", "compressed ply", "ply"])
def test_splat_transform_reads_what_we_write(transform, cloud, tmp_path, name):
    """It sees in our file what our own reader sees."""
    form = FORMATS[name]
    path = tmp_path / f"a{form.suffixes[0]}"
    form.write(path, cloud)
    ours = read_splats(path).cloud
    theirs = read_splats(transform(path, tmp_path / "theirs.ply")).cloud
    if name == "spz":
        theirs = rotate_cloud(theirs, HALF_TURN)
    assert_same(ours, theirs, covariance=QUANTISED.get(name, 2e-6))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.spz", ("--spz-version", "3")),
        ("a.spz", ("--spz-version", "4")),
        ("a.sog", ("-g", "cpu", "-i", "2")),
        ("a.compressed.ply", ()),
        ("a.ply", ()),
    ],
)
def test_we_read_what_splat_transform_writes(transform, cloud, tmp_path, name, options):
    write_ply(tmp_path / "in.ply", cloud)
    path = transform(tmp_path / "in.ply", tmp_path / name, *options)
    ours = read_splats(path).cloud
    if path.suffix == ".spz":
        ours = rotate_cloud(ours, HALF_TURN)
    assert_same(ours, read_splats(transform(path, tmp_path / "theirs.ply")).cloud)


def test_glb_of_splat_transform(transform, cloud, tmp_path):
    """It reads no .glb itself; what it writes is the half turn about z, in full precision."""
    write_ply(tmp_path / "in.ply", cloud)
    ours = read_splats(transform(tmp_path / "in.ply", tmp_path / "a.glb")).cloud
    assert ours.up == "y"
    assert_same(rotate_cloud(ours, np.diag([-1.0, -1.0, 1.0])), cloud)


# gaussforge stores and reads the harmonics of .ksplat and compressed .ply in another order than the programs that
# these formats come from; it is asked about the rest. It also keeps opacities off 0 and 1.
ODD_HARMONICS = ("ksplat", "compressed.ply")


@pytest.mark.parametrize("name", ["splat", "ksplat", "spz", "sog"])
def test_gaussforge_reads_what_we_write(forge, cloud, tmp_path, name):
    form = FORMATS[name]
    path = tmp_path / f"a{form.suffixes[0]}"
    form.write(path, cloud)
    (tmp_path / "theirs.ply").write_bytes(forge(path.read_bytes(), name, "ply"))
    ours, theirs = read_splats(path).cloud, read_splats(tmp_path / "theirs.ply").cloud
    assert_same_but_for_its_oddities(ours, theirs, name)


@pytest.mark.parametrize(
    ("name", "options"),
    [*((name, {}) for name in ("splat", "ksplat", "spz", "sog", "compressed.ply", "ply")), ("spz", {"spz_version": 4})],
)
def test_we_read_what_gaussforge_writes(forge, cloud, tmp_path, name, options):
    write_ply(tmp_path / "in.ply", cloud)
    path = tmp_path / f"a.{name}"
    path.write_bytes(forge((tmp_path / "in.ply").read_bytes(), "ply", name, **options))
    (tmp_path / "theirs.ply").write_bytes(forge(path.read_bytes(), name, "ply"))
    assert_same_but_for_its_oddities(read_splats(path).cloud, read_splats(tmp_path / "theirs.ply").cloud, name)


def assert_same_but_for_its_oddities(ours: SplatCloud, theirs: SplatCloud, name: str) -> None:
    degree = 0 if name in ODD_HARMONICS else ours.sh_degree
    ours, theirs = (with_degree(cloud, degree) for cloud in (ours, theirs))
    assert_same(ours, theirs, covariance=QUANTISED.get(name, 2e-6), opacity=2e-3)


@pytest.mark.parametrize("version", [3, 4])
def test_gsply_reads_our_spz_and_we_its(cloud, tmp_path, version):
    gsply = pytest.importorskip("gsply")
    write_spz(tmp_path / "ours.spz", cloud, version=version)
    data = gsply.read_spz(tmp_path / "ours.spz")
    ours = read_splats(tmp_path / "ours.spz").cloud
    np.testing.assert_allclose(ours.means, data.means, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", ours.quats, data.quats)), 1.0, atol=1e-5)
    gsply.write_spz(tmp_path / "theirs.spz", data, version=version)
    again = read_splats(tmp_path / "theirs.spz").cloud
    step = 2.0**-12  # of its coordinates
    np.testing.assert_allclose(again.means, ours.means, atol=step)
    np.testing.assert_allclose(covariances(again), covariances(ours), atol=0.02)
    np.testing.assert_allclose(again.sh[:, 0], ours.sh[:, 0], atol=0.03)


@pytest.mark.skipif(not ASSETS.is_dir(), reason="no shared assets")
@pytest.mark.parametrize("name", ["pc_biker.spz", "pc_biker.compressed.ply"])
def test_a_real_capture_in_two_formats(name):
    """The very splats of pc_biker.ply: centres within a step, colours within a byte."""
    folder = ASSETS / "splats"
    wanted, found = read_splats(folder / "pc_biker.ply").cloud, read_splats(folder / name).cloud
    assert found.count == wanted.count
    if found.up:
        found = rotate_cloud(found, HALF_TURN)
    low, high = wanted.bounds()
    for cloud in (found, wanted):
        np.testing.assert_allclose(cloud.bounds(), (low, high), atol=2e-3)
    if name.endswith(".spz"):  # the compressed .ply has another order
        np.testing.assert_allclose(found.means, wanted.means, atol=2.0**-12)
        np.testing.assert_allclose(found.base_colors(), wanted.base_colors(), atol=1.9 / 255)
        np.testing.assert_allclose(found.opacities, wanted.opacities, atol=1 / 255)
