# SPDX-License-Identifier: GPL-3.0-or-later
"""The job folder: what is asked of a worker, what it answers, and how it is checked."""

from __future__ import annotations
