# SPDX-License-Identifier: GPL-3.0-or-later

from dataclasses import replace

import numpy as np
import pytest
from benchmark_bodies import capsule_asset, result, two_bones

from benchmarks.paper.rows import Row, Table, tables
from benchmarks.paper.text import read_facts, table_text, tuning_text
from benchmarks.quality.anchored import AnchoredJudge, welded
from benchmarks.quality.cases import CASES, isotropic
from benchmarks.quality.judge import MOST_PSNR
from benchmarks.quality.methods import create_method
from benchmarks.quality.methods.variant import parse
from benchmarks.quality.protocol import Protocol
from gskin_addon.core.errors import InputError
from gskin_addon.core.training.rigged import RiggedMesh

SMALL = Protocol(frames=3, picture_frames=2, views=2, size=64, poses=2)


@pytest.fixture(scope="module")
def anchored():
    """The judge of a capsule on its mesh, and the true weights of the vertices."""
    asset = capsule_asset(600)
    verts, faces = asset.surface.verts, asset.surface.faces
    upper = np.clip((verts[:, 0] - 0.8) / 0.4, 0, 1)
    weights = np.stack([1 - upper, upper], 1)
    rigged = RiggedMesh(verts, faces, np.zeros((len(faces), 3, 3)), weights, two_bones(), np.ones(2, bool))
    _, _, new = welded(asset)  # welding puts vertices into another order
    return AnchoredJudge(asset, rigged, SMALL), asset, weights[np.argsort(new)]


def test_on_the_mesh_its_true_weights_are_right_and_those_of_splats_nearly(anchored):
    judge, asset, weights = anchored
    assert len(judge.mesh[0]) == len(weights)
    assert judge.score(weights).psnr == MOST_PSNR
    from_splats, wrong = judge.score(asset.weights), judge.score(np.full_like(asset.weights, 0.5))
    assert from_splats.error < 0.01
    assert MOST_PSNR > from_splats.psnr > wrong.psnr + 5
    assert np.allclose(judge.to_vertices(asset.weights).sum(axis=1), 1)


def test_isotropic_splats_are_balls_of_the_same_volume():
    asset = capsule_asset(50)
    balls = isotropic(asset).asset.cloud.scales
    assert np.allclose(balls, balls[:, :1])
    assert np.allclose(balls.prod(axis=1), np.maximum(asset.cloud.scales, 1e-12).prod(axis=1), rtol=1e-3)


def test_a_job_has_any_settings_by_its_name():
    settings, on_mesh = parse("job:init=visibility,guidance=elastic,loss.arap=0,views=2,mesh=1")
    assert settings == {"init": "visibility", "guidance": "elastic", "losses": {"arap": 0}, "views": 2}
    assert on_mesh
    with pytest.raises(ValueError, match="not 'job:"):
        parse("job:views")


def test_every_row_is_a_method_in_a_case_that_exist():
    for table in tables("elastic", "draft", []):
        for row in table.rows:
            assert row.case in CASES
            if not row.method.startswith("file:"):
                assert create_method(row.method).limit > 0


def test_methods_of_others_are_rows_and_the_papers_have_their_numbers():
    found = {table.key: table.rows for table in tables("elastic", "draft", ["file:theirs", "file:UniRig"])}
    assert list(found) == ["vanilla", "anchored", "isotropic", "ablation", "skeletons"]
    rows = {row.method: row for row in found["anchored"]}
    assert rows["file:theirs"].title == "theirs"
    assert rows["file:UniRig"].title == "UniRig"
    assert rows["file:UniRig"].paper == (25.61, 0.959, 0.0478)
    assert "file:unirig" not in rows
    assert rows["file:puppeteer"].title == "Puppeteer"


def test_means_are_over_the_assets_that_all_rows_have_and_what_is_missing_is_said():
    rows = (Row("first", "initial"), Row("second", "bbw", paper=(22.11, 0.935, 0.058)), Row("third", "heat_mesh"))
    results = [result("a", "initial", 1.0), result("a", "bbw", 3.0), result("b", "initial", 9.0)]
    results[1] = replace(results[1], status="failed")
    known = {(r.asset, r.method, r.skeleton): r for r in results}
    text = table_text(Table("t", "A table", rows), ["a", "b"], known)
    assert "1 asset: a." in text
    assert "| first | 29.00 | 0.9000 | - | 1.000 | - | - |" in text
    assert "| second | 27.00 | 0.9000 | - | 3.000 | 1 failed | 22.11 / 0.935 / 0.0580 |" in text
    assert "Not run: third." in text


def test_fine_tuning_comes_from_the_report_of_a_training():
    assert "Not run" in tuning_text(None)
    scores = {"psnr": 20.0, "ssim": 0.9, "raw_psnr": 18.5}
    text = tuning_text({"validation": {"before": scores, "after": {**scores, "psnr": 25.0}}})
    assert "| fine-tuned | 25.00 | 0.900 | - | 18.50 |" in text


@pytest.mark.parametrize(
    "text", ["[1]", "7", '{"validation": [1]}', '{"validation": {"before": 3, "after": {}}}',
             '{"validation": {"before": {"psnr": "high"}, "after": {}}}'],
)  # fmt: skip
def test_a_report_of_another_kind_is_refused(tmp_path, text):
    path = tmp_path / "fine_tuned.json"
    path.write_text('{"validation": {"before": {"psnr": 20, "ssim": null}, "after": {}}}')
    assert read_facts(path)["validation"]["before"]["psnr"] == 20
    path.write_text(text)
    with pytest.raises(InputError, match=r"fine_tuned\.json"):
        read_facts(path)


def test_a_video_has_all_frames_whatever_is_installed(tmp_path, monkeypatch):
    from PIL import Image

    from benchmarks.paper.videos import DIMENSIONS, needs, write_video

    monkeypatch.setattr("shutil.which", lambda name: None)
    pictures = [np.full((8, 8, 3), value) for value in (0.0, 0.5, 1.0)]
    path = write_video(tmp_path / "ours" / "capsule", pictures, 10, keep_frames=True)
    assert path.name == "capsule.gif"
    assert Image.open(path).n_frames == 3
    assert len(list((tmp_path / "ours" / "capsule").glob("*.png"))) == 3
    told = needs(tmp_path, ["ours"])
    assert "ffmpeg is not on the PATH" in told
    assert all(f"--dimension {name} --videos_path {tmp_path / 'ours'}" in told for name in DIMENSIONS)


def test_lpips_is_made_of_a_backbone_and_heads_on_disk(tmp_path):
    torch = pytest.importorskip("torch")
    from benchmarks.quality.lpips import Perceptual
    from benchmarks.quality.lpips_file import LAYERS, Lpips, write

    torch.manual_seed(0)
    backbone, heads = {}, {}
    for number, (place, inside, outside, kernel, _, _) in enumerate(LAYERS):
        backbone[f"features.{place}.weight"] = 0.1 * torch.randn(outside, inside, kernel, kernel)
        backbone[f"features.{place}.bias"] = torch.randn(outside)
        heads[f"lin{number}.model.1.weight"] = torch.rand(1, outside, 1, 1)
    write(Lpips(backbone, heads).eval(), tmp_path / "lpips.pt")
    network = Perceptual(tmp_path / "lpips.pt")
    rng = np.random.default_rng(0)
    image, other = rng.random((2, 64, 80, 3)).astype(np.float32)
    assert network(image, image) == 0
    slightly, wholly = network(image, 0.9 * image + 0.1 * other), network(image, other)
    assert 0 < slightly < wholly
    assert network(other, image) == pytest.approx(wholly, rel=1e-4)
    twice = {name: 2 * value for name, value in heads.items()}
    with torch.no_grad():
        images = [torch.from_numpy(x).permute(2, 0, 1)[None] * 2 - 1 for x in (image, other)]
        assert float(Lpips(backbone, twice)(*images)) == pytest.approx(2 * wholly, rel=1e-4)
    with pytest.raises(ValueError, match=r"no features\.3\.bias"):
        Lpips({k: v for k, v in backbone.items() if k != "features.3.bias"}, heads)
    with pytest.raises(ValueError, match="has the shape"):
        Lpips({**backbone, "features.0.bias": torch.rand(3)}, heads)
