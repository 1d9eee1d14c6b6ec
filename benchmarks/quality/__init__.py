# SPDX-License-Identifier: GPL-3.0-or-later
"""Every way to make weights, on rigged assets whose true weights are known: python -m benchmarks.quality."""
