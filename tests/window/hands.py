# SPDX-License-Identifier: GPL-3.0-or-later
"""Our own tools on splats by the artist's hands: every button of the side bar by a click, judged by what it changed.

blender --python tests/window/hands.py -- --out DIR --splats FILE.ply --rig RIG [--only CHAPTER]

Called as a script calls them: which bone's group is active, which objects are selected, and from where the view looks.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from arriving import PANELS, arrive, auto_skin, bring_in, import_splats, remember
from chapters.desk import Desk
from chapters.editing import editing
from chapters.selecting import selecting
from chapters.separating import separating
from chapters.showing import showing
from chapters.skeletons import skeletons
from chapters.transferring import transferring
from chapters.trying import trying
from stage import Hands, Stage, Story, View, perform, story_parser

CHAPTERS = {"try": trying, "show": showing, "select": selecting, "edit": editing, "transfer": transferring,
            "separate": separating}  # fmt: skip
"""On the figure with weights; the skeletons come before it has any."""


def story(stage: Stage, options: argparse.Namespace) -> Story:
    """All chapters, or those that are asked for."""
    view = View()
    desk = Desk(stage, Hands(options.out, view, stage.views), view)
    wanted = options.only or ["skeletons", *CHAPTERS]
    yield from arrive(stage, desk.hands, view, *PANELS)
    import_splats(view, options.splats, "z")
    if "skeletons" in wanted:
        yield from stage.attempt("the chapter skeletons", skeletons(desk, options.rig))
    _, rig = bring_in(view, options.splats, options.rig, "z")
    rig.show_in_front, rig.data.display_type = True, "STICK"
    remember(view, "Bring in splats and armature")
    desk.look()
    yield stage.pause(1.0)
    yield from auto_skin(stage, view)
    stage.numbers["splats"] = len(desk.splats.data.vertices)
    yield from desk.hands.shoot("w10_skinned")
    for name in wanted:
        if name in CHAPTERS:
            yield from stage.attempt(f"the chapter {name}", CHAPTERS[name](desk))
            yield from desk.tab("OBJECT")
            remember(view, name)
    stage.chapter = "end"


def main() -> None:
    """Read the arguments behind `--` and start."""
    parser = story_parser()
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--only", action="append", choices=["skeletons", *CHAPTERS])
    perform(story, parser)


if __name__ == "__main__":
    main()
