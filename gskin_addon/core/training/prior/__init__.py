# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the built-in network: made-up and real rigged bodies, samples, and the loop."""

from __future__ import annotations
