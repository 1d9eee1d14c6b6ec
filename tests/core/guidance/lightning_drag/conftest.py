# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import os
from pathlib import Path

import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")


@pytest.fixture(scope="session")
def models(tmp_path_factory) -> Path:
    """Tiny models in LightningDrag's layout; copy before changing a file."""
    pytest.importorskip("diffusers")
    pytest.importorskip("transformers")
    from tests.helpers.tiny_lightning import write_models

    return write_models(tmp_path_factory.mktemp("lightning") / "models")
