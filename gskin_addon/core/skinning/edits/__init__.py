# SPDX-License-Identifier: GPL-3.0-or-later
"""An artist's changes to weights: smooth, sharpen, mirror, assign. Flat functions on arrays, numpy only."""
