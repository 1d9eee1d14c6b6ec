# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that work between redraws: what Blender asks them in a window, played without one."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

bpy = pytest.importorskip("bpy")

from gskin_addon.core.errors import InputError
from gskin_addon.operators import _sliced

TIMER, ESCAPE, MOUSE = (SimpleNamespace(type=kind, value="PRESS") for kind in ("TIMER", "ESC", "MOUSEMOVE"))


class Probe(_sliced.Sliced):
    """Three slices, of which the last does something or refuses."""

    bl_label = "Probe"

    def __init__(self, error=None, asked=True):
        self.error, self.asked, self.done, self.closed, self.said = error, asked, False, False, []

    def report(self, kind, text):
        self.said.append((*kind, text))

    def work(self, context):
        try:
            yield 0.3
            yield 0.6
            if self.error is not None:
                raise self.error
            self.done = True
            return "all of it"
        finally:
            self.closed = True


@pytest.fixture
def context(monkeypatch):
    """A window as Blender gives it; its timers and status texts are kept in `timers` and `texts`."""
    monkeypatch.setattr(_sliced, "BUDGET", 0.0)
    monkeypatch.setattr(_sliced, "bpy", SimpleNamespace(app=SimpleNamespace(background=False)))
    timers, texts, handlers = [], [], []
    manager = SimpleNamespace(
        event_timer_add=lambda pause, window: timers.append(pause) or pause,
        event_timer_remove=timers.remove,
        modal_handler_add=handlers.append,
    )
    space = SimpleNamespace(status_text_set=texts.append)
    return SimpleNamespace(window=object(), window_manager=manager, workspace=space, timers=timers, texts=texts)


def test_it_goes_on_with_every_tick_and_says_its_sentence(context):
    probe = Probe()
    assert probe.begin(context) == {"RUNNING_MODAL"}
    assert probe.modal(context, MOUSE) == {"RUNNING_MODAL"}
    assert probe.modal(context, TIMER) == {"RUNNING_MODAL"}
    assert context.texts[-1] == "Probe: 30%  (Esc cancels)"
    assert not probe.done
    probe.modal(context, TIMER)
    assert probe.modal(context, TIMER) == {"FINISHED"}
    assert probe.done
    assert probe.said == [("INFO", "all of it")]
    assert (context.timers, context.texts[-1]) == ([], None)


def test_escape_ends_it_before_anything_is_done(context):
    probe = Probe()
    probe.begin(context)
    probe.modal(context, TIMER)
    assert probe.modal(context, ESCAPE) == {"CANCELLED"}
    assert (probe.done, probe.closed, context.timers, context.texts[-1]) == (False, True, [], None)
    assert probe.said == [("WARNING", "Cancelled; nothing was changed")]


@pytest.mark.parametrize("asked", [True, False])
def test_a_refusal_is_said_in_a_window_and_to_scripts(context, asked):
    probe = Probe(InputError("'S' is no splat object."), asked)
    answer = probe.begin(context)
    for _ in range(3 if asked else 0):
        answer = probe.modal(context, TIMER)
    assert answer == {"CANCELLED"}
    assert probe.said == [("ERROR", "'S' is no splat object.")]
    assert context.timers == []


def test_a_fault_leaves_no_timer_behind(context):
    probe = Probe(ZeroDivisionError())
    probe.begin(context)
    probe.modal(context, TIMER)
    probe.modal(context, TIMER)
    with pytest.raises(ZeroDivisionError):
        probe.modal(context, TIMER)
    assert (context.timers, context.texts[-1]) == ([], None)


def test_scripts_have_it_at_once(context):
    probe = Probe(asked=False)
    assert probe.begin(context) == {"FINISHED"}
    assert probe.done
