# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames through a pipe and by a process of their own."""

from __future__ import annotations

import io
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import splat_clouds as clouds

from gskin_addon.core.errors import GSkinError, InputError
from gskin_addon.core.render.camera import look_at
from gskin_addon.core.render.drawn_splats import DrawnSplats, drawn_cloud
from gskin_addon.core.render.frame import Frame, draw_frame
from gskin_addon.core.render.output import Output
from gskin_addon.core.worker import frame_worker
from gskin_addon.core.worker.frame_client import FrameClient
from gskin_addon.core.worker.frame_pipe import pack_frame, read_frames


def frame():
    splats = drawn_cloud(clouds.random_cloud(20, 2), np.diag([2.0, 2.0, 2.0, 1.0]))
    turned = replace(splats, turns=np.tile(np.float32([0.6, 0.8, 0, 0]), (20, 1)))
    camera = look_at((0, -9, 1), (0, 0, 0), size=(30, 40))
    # As Blender's newer matrices give them.
    camera = replace(camera, fx=np.float32(camera.fx), rotation=camera.rotation.astype(np.float32))
    return Frame([splats, turned], camera, np.random.default_rng(0).normal(size=(5, 3, 3)).astype(np.float32), 50.0)


def test_a_frame_comes_through_whole(tmp_path):
    output = Output(str(tmp_path / "a.png"), "png", background=(0.1, 0.2, 0.3))
    sent = frame()
    messages = b"".join(pack_frame(3, sent, output)) + b"".join(pack_frame(4, replace(sent, far=np.inf), output))
    (number, got, where), (_, endless, _) = read_frames(io.BytesIO(messages))
    assert number == 3
    assert where == output
    assert got.far == 50.0
    assert np.isinf(endless.far)
    np.testing.assert_array_equal(got.triangles, sent.triangles)
    for mine, theirs in zip(got.objects, sent.objects, strict=True):
        for name in DrawnSplats.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
    np.testing.assert_array_equal(draw_frame(got)[0].color, draw_frame(sent)[0].color)


@pytest.mark.parametrize("share", [0.2, 0.9, 0.999])
def test_a_message_that_breaks_off_is_no_frame(share, tmp_path):
    whole = b"".join(pack_frame(1, frame(), Output(str(tmp_path / "a.png"), "png")))
    with pytest.raises(ValueError, match=r"closed|Expecting|Unterminated|delimiter"):
        list(read_frames(io.BytesIO(whole[: int(share * len(whole))])))


def test_pictures_come_from_elsewhere_too(tmp_path):
    picture = np.random.default_rng(1).random((30, 40, 4)).astype(np.float32)
    none = np.zeros((0, 3, 3), np.float32)
    sent = replace(frame(), objects=[], picture=picture, triangles=none)
    ((_, got, _),) = read_frames(io.BytesIO(b"".join(pack_frame(1, sent, Output("a.png", "png")))))
    drawn, hidden = draw_frame(got)
    np.testing.assert_array_equal(drawn.color, picture[..., :3])
    assert not hidden.any()
    hides = replace(frame(), picture=picture)
    np.testing.assert_array_equal(draw_frame(hides)[1], draw_frame(frame())[1])
    assert draw_frame(hides)[1].any()


def test_kernels_are_compiled_before_the_first_frame_and_it_is_said(monkeypatch):
    pytest.importorskip("numba")
    from gskin_addon.core.render.cpu import compiled, still

    still.compile_kernel()
    assert not still.has_to_compile()
    lines = []
    frame_worker._compile(lines.append)
    assert lines == []
    monkeypatch.setattr(compiled.Path, "glob", lambda self, pattern: iter(()))  # an empty cache
    frame_worker._compile(lines.append)
    assert lines == [{"stage": "compiling"}]


def follow(client):
    until = time.monotonic() + 120
    while time.monotonic() < until:
        if any(line["stage"] == "drawn" for line in client.poll()):
            return
        time.sleep(0.02)
    raise AssertionError("no picture came")


def test_a_process_draws_and_says_what_is_wrong(tmp_path):
    client = FrameClient(Path(sys.executable))
    try:
        client.draw(1, frame(), Output(str(tmp_path / "a.png"), "png"))
        follow(client)
        assert (tmp_path / "a.png").stat().st_size > 100
        client.draw(2, frame(), Output(str(tmp_path / "nowhere" / "b.png"), "png"))
        with pytest.raises(GSkinError, match=r"b\.png' cannot be written"):
            follow(client)
    finally:
        client.close()


def test_a_python_that_is_none_is_named(tmp_path):
    with pytest.raises(InputError, match="cannot be started to draw splats"):
        FrameClient(tmp_path / "python")
