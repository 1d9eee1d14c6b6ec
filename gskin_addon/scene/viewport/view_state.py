# SPDX-License-Identifier: GPL-3.0-or-later
"""What is kept of one view from redraw to redraw, and how it is brought up to date.

Blender draws a view again for many reasons, as smoothing its edges: splats are drawn again only where something that
they depend on is another. Order and colours come from a thread; until it is done those of before are used.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.render.screen_space import is_orthographic
from ...core.render.view_order import back_to_front, eye_of, view_colors, view_depths
from .drawing import Target, draw_into, make_target
from .marks import Cage, Look, Marks
from .sorter import Sorter
from .textures import PoseTextures, color_texture, image_texture, order_texture, pose_textures
from .visible import Shown

VIEWS = 8
"""Views that are kept; one of a 3D view's four regions is a view."""

sorter = Sorter()
_views: OrderedDict[int, ViewState] = OrderedDict()
_textures: OrderedDict[Any, PoseTextures] = OrderedDict()


class ViewState:
    """One view's order, colours and targets, each with what it was made for."""

    def __init__(self, asker: int) -> None:
        self.asker = asker
        self.target: Target | None = None
        self.drawn_for: Any = None
        self._selected: Target | None = None
        self._marks: Marks | None = None
        self._selected_for: Any = None
        self._order: Any = None
        self._colors: Any = None
        self._layout: Any = None
        self._order_for: Any = None
        self._colors_for: Any = None
        self._depths: NDArray[np.float32] | None = None
        self._depth_texture: Any = None
        self._depths_seen = 0

    def arrange(self, shown: Sequence[Shown], view: Any, projection: Any, *, at_once: bool) -> bool:
        """Take the order and colours that the thread has made, and ask for others where these are not the view's.

        Made here and now where there are none that fit, or `at_once`. Returns whether the thread was asked.
        """
        objects = [one.splats for one in shown]
        layout = tuple((one.rest_key, one.splats.count) for one in shown)
        poses = tuple(one.pose_key for one in shown)
        matrices = b"".join(splats.matrix.tobytes() for splats in objects)
        order_for = (poses, matrices, view[2].tobytes())
        colors_for: Any = (layout,)
        if any(splats.sh.shape[1] > 1 and splats.colors is None for splats in objects):
            colors_for = (layout, poses, matrices, view.tobytes(), is_orthographic(projection))
        elif any(splats.colors is not None for splats in objects):
            colors_for = (layout, poses)
        wanted = (order_for, colors_for)
        if wanted == (self._order_for, self._colors_for):
            return False
        recolor = self._colors_for != colors_for

        def job() -> Any:
            order = back_to_front(np.concatenate([view_depths(splats, view) for splats in objects]))
            if not recolor:
                return layout, order, None
            eyes = (eye_of(view, projection, splats.matrix) for splats in objects)
            colors = [view_colors(splats, eye) for splats, eye in zip(objects, eyes, strict=True)]
            return layout, order, [(rgb, s.opacities) for rgb, s in zip(colors, objects, strict=True)]

        at_once = at_once or self._layout != layout
        done = (wanted, job()) if at_once else sorter.take(self.asker)
        if done is not None and done[1][0] == layout:
            made_for, (self._layout, order, colors) = done
            self._order, self._order_for = order_texture(order), made_for[0]
            if colors is not None:
                self._colors, self._colors_for = color_texture(colors), made_for[1]
        if (self._order_for, self._colors_for) == wanted:
            return False
        sorter.ask(self.asker, wanted, job)
        return True

    def draw(
        self, shown: Sequence[Shown], view: Any, projection: Any, size: tuple[int, int],
        depths: NDArray[np.float32] | None,
    ) -> None:  # fmt: skip
        """Bring the target up to date; size: (width, height) in pixels, depths (height, width) of what may hide."""
        known, new = self._depths, depths
        if (known is None) != (new is None) or (known is not None and not np.array_equal(known, new)):
            self._depths, self._depth_texture = new, None if new is None else image_texture(new)
            self._depths_seen += 1
        if self.target is None or (self.target.width, self.target.height) != size:
            self.target, self._selected, self.drawn_for = make_target(*size), None, None
        poses = tuple(one.pose_key for one in shown)
        matrices = b"".join(one.splats.matrix.tobytes() for one in shown)
        here = (view.tobytes(), projection.tobytes(), size)
        drawn_for = (poses, matrices, self._order_for, self._colors_for, here, self._depths_seen)
        if self.drawn_for != drawn_for:
            self._draw_into(self.target, shown, self._order, view, projection)
            self.drawn_for = drawn_for

    def selected(self, shown: Sequence[Shown], taken: Sequence[bool], view: Any, projection: Any) -> Any:
        """A texture whose alpha is that of the objects `taken` alone; call `draw` first."""
        target = self.target
        assert target is not None
        if all(taken):
            return target.texture
        selected_for = (self.drawn_for, tuple(taken))
        if self._selected is None or self._selected_for != selected_for:
            ends = np.cumsum([0, *(one.splats.count for one in shown)])
            # Alpha adds up to the same in any order.
            order = np.concatenate([np.arange(ends[i], ends[i + 1]) for i, here in enumerate(taken) if here])
            self._selected = self._selected or make_target(target.width, target.height)
            self._draw_into(self._selected, shown, order_texture(order), view, projection, len(order))
            self._selected_for = selected_for
        return self._selected.texture

    def marked(self, cages: Sequence[Cage], view: Any, projection: Any, look: Look, *, through: bool) -> Marks:
        """The marks of Edit Mode, up to date; call `draw` first."""
        assert self.target is not None
        if self._marks is None or self._marks.size != (self.target.width, self.target.height):
            self._marks = Marks(self.target.width, self.target.height)
        self._marks.draw(cages, view, projection, look, through=through)
        return self._marks

    def _draw_into(
        self, target: Target, shown: Sequence[Shown], order: Any, view: Any, projection: Any, count: int | None = None
    ) -> None:
        matrices = [one.splats.matrix for one in shown]
        draw_into(
            target, _pose_textures(shown), matrices, order, self._colors, view, projection,
            count=count, depths=self._depth_texture,
        )  # fmt: skip


def view_state(asker: int) -> ViewState:
    """The state of the view known by a number; a new one where there is none."""
    if asker not in _views:
        _views[asker] = ViewState(asker)
        while len(_views) > VIEWS:
            _views.popitem(last=False)
    _views.move_to_end(asker)
    return _views[asker]


def _pose_textures(shown: Sequence[Shown]) -> PoseTextures:
    """Shared by the views that show the same."""
    key = tuple(one.pose_key for one in shown)
    if key not in _textures:
        _textures[key] = pose_textures([one.splats for one in shown])
        while len(_textures) > 2:
            _textures.popitem(last=False)
    _textures.move_to_end(key)
    return _textures[key]


def forget() -> None:
    """Drop all views, with what waits for them."""
    sorter.forget()
    _views.clear()
    _textures.clear()
